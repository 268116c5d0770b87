"""The command line: help that is quick and complete, suggestions, and exit codes that scripts can trust."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from agent import __version__
from agent.cli import COMMANDS, command_parser, load_command, main
from agent.exits import BUG, EXIT_CODES, INTERRUPTED
from agent.map_files import save_map
from protocol.geometry import SE2
from protocol.grid import OccupancyGrid


def test_every_command_is_there_with_its_help() -> None:
    for name, (module, summary) in COMMANDS.items():
        assert importlib.util.find_spec(module), f"{name}: {module} is missing"
        text = command_parser(name).format_help()
        assert text.startswith(f"usage: mapquilt {name} ")
        assert summary[1:] in text
        assert f"mapquilt {name}" in text.split("examples:")[1] or module.endswith("control")


def test_help_imports_no_command_and_no_package() -> None:
    probe = (
        "import sys; from agent.cli import main\ntry: main(['--help'])\nexcept SystemExit: pass\n"
        "print([m for m in ('numpy', 'cv2', 'zenoh', 'agent.commands.run') if m in sys.modules], file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True, check=True)
    assert done.stderr == "[]\n"
    for name in COMMANDS:
        assert f"\n  {name} " in done.stdout
    assert EXIT_CODES in done.stdout


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main(["--version"])
    assert end.value.code == 0
    assert capsys.readouterr().out == f"mapquilt {__version__}\n"


def test_an_unknown_command_is_answered_with_the_nearest(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["merg"]) == 2
    assert capsys.readouterr().err == "mapquilt: unknown command 'merg'; did you mean 'merge'?\n"
    assert main(["xyzzy"]) == 2
    assert "--help lists them" in capsys.readouterr().err
    assert main([]) == 2


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("run --wheel wt1:/dev/x", "run: unknown argument '--wheel'; did you mean '--wheels'?"),
        ("merge a.yaml b.yaml --outptu=x", "merge: unknown argument '--outptu=x'; did you mean '--output'?"),
        ("pause nonsense", "pause: unknown argument 'nonsense'; mapquilt pause --help lists what there is"),
        ("unmerge", "unmerge: the following arguments are required: PEER; mapquilt unmerge --help shows examples"),
    ],
)
def test_a_mistyped_flag_is_answered_in_one_line(words: str, said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words.split()) == 2
    assert capsys.readouterr() == ("", f"mapquilt: {said}\n")


@pytest.mark.parametrize(
    ("words", "code"), [("merge a.yaml b.yaml", 4), ("merge a.yaml", 2), ("merge", 2), ("merge a.yaml b.yaml --nonsense", 2)]
)
def test_json_is_one_object_also_when_it_fails(words: str, code: int, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*words.split(), "--json"]) == code
    out, err = capsys.readouterr()
    answer = json.loads(out)
    assert (answer["accepted"], answer["status"], answer["exit_code"]) == (False, "error", code)
    assert err == f"mapquilt: {answer['error']}\n"


@pytest.mark.parametrize(
    ("error", "code"), [(KeyboardInterrupt(), INTERRUPTED), (ValueError("odd"), BUG), (RecursionError("deep"), BUG)]
)
def test_whatever_happens_there_is_a_code(
    error: BaseException, code: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(_: object) -> int:
        raise error

    monkeypatch.setattr("agent.commands.config.run", fail)
    assert main(["config"]) == code
    said = capsys.readouterr().err
    assert ("this is a bug of ours" in said) == (code == BUG)


def test_global_flags_stand_before_or_behind_the_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["-q", "config", "show", "--set", "robot.id=r1"]) == 0
    before = capsys.readouterr().out
    assert main(["config", "show", "--set", "robot.id=r1", "-q"]) == 0
    assert capsys.readouterr().out == before


def test_a_reader_that_has_seen_enough_is_no_error() -> None:
    done = subprocess.run(
        f"{shlex.quote(sys.executable)} -m agent config show --json | head -1",
        shell=True,
        capture_output=True,
        text=True,
        check=True,
    )
    assert (done.stdout, done.stderr) == ("{\n", "")


@pytest.mark.parametrize("words", ["config", "config --json"])
def test_a_full_disk_behind_stdout_is_one_sentence(words: str) -> None:
    with Path("/dev/full").open("w") as full:
        command = [sys.executable, "-m", "agent", *words.split()]
        done = subprocess.run(command, check=False, stdout=full, stderr=subprocess.PIPE, text=True)
    assert (done.returncode, done.stderr.count("\n")) == (3, 1)
    assert done.stderr.startswith("mapquilt: No space left on device")


def test_letters_that_a_terminal_lacks_are_shown_as_escapes(tmp_path: Path) -> None:
    save_map(OccupancyGrid(np.zeros((20, 20), np.int8), 0.05, SE2.identity()), tmp_path / "m")
    (tmp_path / "m.yaml").rename(tmp_path / "räum.yaml")
    environ = {**os.environ, "PYTHONIOENCODING": "ascii"}
    words = [sys.executable, "-m", "agent", "features", tmp_path / "räum.yaml"]
    done = subprocess.run(words, check=False, capture_output=True, env=environ)
    assert (done.returncode, b"r\\xe4um.yaml" in done.stdout) == (0, True)


@pytest.mark.parametrize("name", list(COMMANDS))
def test_the_examples_of_a_command_can_be_typed(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    module = load_command(name)
    lines = [line for line in module.EXAMPLES.splitlines() if re.match(r"\s*(sudo )?mapquilt ", line)]
    assert lines or not module.EXAMPLES
    for line in lines:
        words = shlex.split(re.split(r"\s{2,}|\s>\s|\|", line.strip().removeprefix("sudo ").removeprefix("mapquilt "))[0])
        try:
            command_parser(words[0]).parse_args(words[1:])
        except SystemExit:
            pytest.fail(f"{line}: {capsys.readouterr().err}")


def test_ctrl_c_while_libraries_load_ends_at_once_and_is_no_bug() -> None:
    probe = (
        "import importlib, os, signal; from agent import cli; signal.signal(signal.SIGINT, signal.default_int_handler);"
        "importlib.import_module = lambda name: os.kill(os.getpid(), signal.SIGINT); cli.main(['run'])"
    )
    done = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (-signal.SIGINT, "")
