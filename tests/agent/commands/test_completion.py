"""Completion files that the shells themselves accept, and a man page that groff does."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from agent.cli import COMMANDS
from tests.agent.commands.conftest import Run


def shell(name: str) -> str:
    found = shutil.which(name)
    if found is None:
        pytest.skip(f"{name} is not installed here")
    return found


@pytest.mark.parametrize("name", ["bash", "zsh", "fish"])
def test_the_shell_can_read_its_file(name: str, run: Run, tmp_path: Path) -> None:
    file = tmp_path / "completion"
    file.write_text(run("completion", name).out)
    flag = "--no-execute" if name == "fish" else "-n"
    done = subprocess.run([shell(name), flag, file], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        (["mapquilt", "fea"], {"features"}),
        (["mapquilt", "status", "--j"], {"--json"}),
        (["mapquilt", "features", "--method", "p"], {"paper"}),
        (["mapquilt", "config", "ch"], {"check"}),
    ],
)
def test_bash_completes(line: list[str], expected: set[str], run: Run, tmp_path: Path) -> None:
    file = tmp_path / "completion"
    file.write_text(run("completion", "bash").out)
    words = " ".join(f"'{word}'" for word in line)
    script = f"source {file}; COMP_WORDS=({words}); COMP_CWORD={len(line) - 1}; _mapquilt; printf '%s\\n' \"${{COMPREPLY[@]}}\""
    done = subprocess.run([shell("bash"), "-c", script], capture_output=True, text=True, check=True, cwd=tmp_path)
    assert expected <= set(done.stdout.split())
    assert len(done.stdout.split()) <= 2


def test_fish_completes(run: Run, tmp_path: Path) -> None:
    file = tmp_path / "mapquilt.fish"
    file.write_text(run("completion", "fish").out)
    asked = [shell("fish"), "--no-config", "-c", f"source {file}; complete -C 'mapquilt fea'; complete -C 'mapquilt status --js'"]
    done = subprocess.run(asked, capture_output=True, text=True, check=True, env={"HOME": str(tmp_path), "PATH": "/usr/bin:/bin"})
    assert [line.split("\t")[0] for line in done.stdout.splitlines()] == ["features", "--json"]


def test_the_man_page_tells_every_command(run: Run, tmp_path: Path) -> None:
    page = run("completion", "man").out
    for name in COMMANDS:
        assert f"\n.SS {name}\n" in page
    file = tmp_path / "mapquilt.1"
    file.write_text(page)
    done = subprocess.run([shell("groff"), "-man", "-Tascii", "-ww", file], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert "mapquilt - robots that explore apart" in done.stdout
