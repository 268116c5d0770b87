"""`./run`: one clear sentence when a machine will not do, a whole .venv after any interruption, and no wait afterwards.

The script runs for real, in a checkout of its own whose locks are empty and whose packages are five empty modules, so that no
network is needed; `tests/campaigns/bootstrap.py` does the same with the real locks.
"""

from __future__ import annotations

import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
TOOLS = ("sh", "readlink", "sha256sum", "cut", "sed", "cat", "rm", "mkdir", "mv", "chmod", "flock")
LOCKS = ("requirements.lock", "requirements-dev.lock")


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A place that looks like a clone, with a space and a quote in its path."""
    place = tmp_path / "it's a clone"
    (place / "agent").mkdir(parents=True)
    shutil.copy(ROOT / "run", place / "run")
    for lock in LOCKS:
        (place / lock).write_text("# nothing\n")
    for module in ("zenoh", "numpy", "cv2", "msgpack", "serial", "agent/__init__"):
        (place / f"{module}.py").write_text("")
    (place / "agent" / "__main__.py").write_text("import os, sys\nprint(os.getcwd(), sys.argv[1:])\n")
    return place


@pytest.fixture
def machine(tmp_path: Path) -> Path:
    """A directory that is the whole PATH: the usual tools, 64-bit Linux, no Python yet."""
    tools = tmp_path / "bin"
    tools.mkdir()
    for tool in TOOLS:
        found = shutil.which(tool)
        assert found, f"{tool} is part of every Linux"
        (tools / tool).symlink_to(found)
    program(tools / "uname", 'case "$1" in -m) echo x86_64;; *) echo Linux;; esac')
    return tools


def program(path: Path, text: str) -> None:
    path.unlink(missing_ok=True)
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)


def start(checkout: Path, machine: Path, *words: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    environ = {"PATH": str(machine), "HOME": str(machine.parent), "PYTHONPATH": "/opt/ros/elsewhere"}
    return subprocess.run(
        [checkout / "run", *words], env=environ, cwd=cwd or machine, capture_output=True, text=True, timeout=300, check=False
    )


def cpu_s() -> float:
    """CPU time of the children so far: what a start costs, however busy the machine is."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def refusal(checkout: Path, machine: Path) -> str:
    done = start(checkout, machine, "demo")
    assert done.returncode == 3
    assert done.stdout == ""
    assert done.stderr.startswith("mapquilt: ")
    assert done.stderr.count("\n") == 1, done.stderr
    return done.stderr


def test_a_machine_that_will_not_do_gets_one_sentence(checkout: Path, machine: Path) -> None:
    assert refusal(checkout, machine).endswith("install it with: sudo apt-get install python3 python3-venv\n")
    program(machine / "python3", "echo old 3.9; exit 1")
    assert "python3 is 3.9; let uv bring one without touching the system: python3 -m pip install --user uv" in refusal(
        checkout, machine
    )
    program(machine / "python3.11", "echo novenv 3.11; exit 1")
    assert "has no venv module; install it with: sudo apt-get install python3.11-venv" in refusal(checkout, machine)
    program(machine / "python3.11", "echo 32bit 3.11; exit 1")
    assert "write the 64-bit Raspberry Pi OS to the card with: rpi-imager" in refusal(checkout, machine)
    program(machine / "uname", 'case "$1" in -m) echo armv7l;; *) echo Linux;; esac')
    assert "this is armv7l; on a Raspberry Pi 3 or newer, write the 64-bit" in refusal(checkout, machine)
    program(machine / "uname", "echo Darwin")
    assert "this runs on Linux only, and this is Darwin" in refusal(checkout, machine)
    assert not (checkout / ".venv").exists()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere, so a read-only checkout cannot be shown as root")
def test_a_checkout_that_cannot_be_written_says_so(checkout: Path, machine: Path) -> None:
    checkout.chmod(0o555)
    assert "take a copy of your own with: git clone" in refusal(checkout, machine)


@pytest.mark.timeout(400)  # makes an environment: seconds, minutes on a machine under heavy load
def test_the_first_start_installs_the_second_only_starts(checkout: Path, machine: Path) -> None:
    (machine / "python3").symlink_to(sys.executable)
    venv = checkout / ".venv"

    elsewhere = machine.parent
    first = start(checkout, machine, "merge", "a b.yaml", "--help", cwd=elsewhere)
    assert first.stdout == f"{elsewhere} ['merge', 'a b.yaml', '--help']\n", first.stderr
    assert "first start" in first.stderr

    marker = venv / "kept"
    marker.touch()
    begin = cpu_s()
    second = start(checkout, machine, "demo")
    assert cpu_s() - begin < 1.0
    assert (second.returncode, second.stderr) == (0, "")

    launcher = subprocess.run([venv / "bin" / "mapquilt", "x"], cwd=elsewhere, capture_output=True, text=True, check=True)
    assert launcher.stdout == f"{elsewhere} ['x']\n"

    (checkout / LOCKS[0]).write_text("# something else\n")  # a new lock: brought up to date, not made anew
    assert "up to date" in start(checkout, machine, "demo").stderr
    assert start(checkout, machine, "demo").stderr == ""
    assert marker.exists()

    checkout = checkout.rename(checkout.with_name("moved"))  # moved: the launcher and the path entry follow
    venv = checkout / ".venv"
    assert start(checkout, machine, "demo").returncode == 0
    assert str(checkout) in (venv / "bin" / "mapquilt").read_text()


@pytest.mark.timeout(400)
def test_a_start_that_was_killed_or_failed_is_made_good_by_the_next(checkout: Path, machine: Path) -> None:
    (machine / "python3").symlink_to(sys.executable)
    environ = {"PATH": str(machine), "HOME": str(machine.parent)}
    child = subprocess.Popen([checkout / "run", "demo"], env=environ, stderr=subprocess.DEVNULL, start_new_session=True)
    deadline = time.monotonic() + 30
    while not (checkout / ".venv" / "mapquilt.unfinished").exists() and time.monotonic() < deadline:
        os.sched_yield()
    os.killpg(child.pid, signal.SIGKILL)
    child.wait()
    assert not (checkout / ".venv" / "mapquilt.stamp").exists()

    (checkout / "requirements.lock").write_text("--no-index\nnot-there==1 --hash=sha256:" + "0" * 64 + "\n")
    failed = start(checkout, machine, "demo")
    assert failed.returncode == 3
    said = "the packages could not be installed (see above); is there a network? then run this again:"
    assert failed.stderr.splitlines()[-1] == f'mapquilt: {said} "{checkout}/run"'

    (checkout / "requirements.lock").write_text("")
    assert start(checkout, machine, "demo").returncode == 0
    assert start(checkout, machine, "demo").stderr == ""


def locked(name: str) -> dict[str, str]:
    """Package -> the lines that pin it."""
    text = re.sub(r"(?m)^#.*\n", "", (ROOT / name).read_text())
    blocks = re.split(r"\n(?=\S)", text.strip())
    return {block.split(" \\", 1)[0]: block for block in blocks}


@pytest.mark.parametrize("name", LOCKS)
def test_every_locked_package_has_its_version_and_hashes(name: str) -> None:
    for package, block in locked(name).items():
        assert re.fullmatch(r"[a-z0-9-]+==[0-9a-z.]+( ; .+)?", package)
        assert re.search(r"--hash=sha256:[0-9a-f]{64}", block), package


def test_what_tests_run_on_is_what_robots_run_on() -> None:
    runtime, tests = locked("requirements.lock"), locked("requirements-dev.lock")
    assert {name: tests.get(name) for name in runtime} == runtime
    assert {name.split("==")[0] for name in runtime} == {
        "eclipse-zenoh", "msgpack", "numpy", "opencv-python-headless", "pyserial",
    }  # fmt: skip


def test_no_file_names_an_index() -> None:
    listed = ""
    if shutil.which("git"):
        listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False).stdout
    files = [ROOT / name for name in listed.split("\0") if name] or list(ROOT.glob("*.lock"))
    address = re.compile(rb"(--(extra-)?index-url|--find-links|\bpypi\.org/simple|files\.pythonhosted)", re.I)
    naming = [path.name for path in files if path.is_file() and path != Path(__file__) and address.search(path.read_bytes())]
    assert naming == []
