"""The installer: run twice it changes nothing, settings are never overwritten, and it leaves as it came.

It runs for real below a directory of its own; only `run`, tested elsewhere, is replaced.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
RUN = """#!/bin/sh
mkdir -p "${0%/*}/.venv/bin"
ln -sf "$(command -v python3)" "${0%/*}/.venv/bin/python"
echo "find-links $PIP_FIND_LINKS"
"""


@pytest.fixture
def source(tmp_path: Path) -> Path:
    place = tmp_path / "my source"
    shutil.copytree(ROOT / "deploy", place / "deploy")
    for room in ("agent", "protocol", "hw"):
        (place / room / "__pycache__").mkdir(parents=True)
        (place / room / "__init__.py").write_text("")
        (place / room / "__pycache__" / "old.pyc").write_text("")
    for name in ("requirements.lock", "requirements-dev.lock", "pyproject.toml", "LICENSE"):
        (place / name).write_text("")
    (place / "run").write_text(RUN)
    (place / "run").chmod(0o755)
    return place


@pytest.fixture
def target(tmp_path: Path) -> Path:
    place = tmp_path / "the root"
    place.mkdir()
    return place


def install(source: Path, *words: object) -> subprocess.CompletedProcess[str]:
    script = source / "deploy" / "install.sh"
    return subprocess.run([script, *map(str, words)], capture_output=True, text=True, timeout=60, check=False)


def files(root: Path) -> dict[str, bytes]:
    """Everything below `root` but Python's own compilations."""
    paths = (Path(folder) / name for folder, _, names in os.walk(root) for name in names)
    return {str(path.relative_to(root)): path.read_bytes() for path in paths if path.is_file() and path.suffix != ".pyc"}


def test_installing_twice_is_installing_once(source: Path, target: Path) -> None:
    first = install(source, "--root", target)
    assert first.returncode == 0, first.stderr
    once = files(target)
    assert {
        "opt/mapquilt/run", "opt/mapquilt/agent/__init__.py", "opt/mapquilt/requirements.lock", "etc/mapquilt/robot.toml",
        "etc/systemd/system/mapquilt@.service", "etc/udev/rules.d/90-mapquilt.rules", "etc/modules-load.d/mapquilt.conf",
    } <= set(once)  # fmt: skip
    assert os.readlink(target / "usr/local/bin/mapquilt") == "/opt/mapquilt/.venv/bin/mapquilt"
    assert os.access(target / "opt/mapquilt/run", os.X_OK)
    assert not (target / "opt/mapquilt/agent/__pycache__/old.pyc").exists()
    assert (target / "etc/mapquilt/fleet").stat().st_mode & 0o7777 == 0o750
    assert install(source, "--root", target).returncode == 0
    assert files(target) == once


def test_settings_are_never_overwritten_and_old_code_goes(source: Path, target: Path) -> None:
    install(source, "--root", target)
    mine = target / "etc/mapquilt/robot.toml"
    mine.write_text("# mine\n")
    (source / "agent" / "new.py").write_text("")
    (target / "opt/mapquilt/agent/gone.py").write_text("")
    install(source, "--root", target)
    assert mine.read_text() == "# mine\n"
    assert (target / "etc/mapquilt/robot.toml.sample").read_text() == (source / "deploy/robot.toml").read_text()
    assert (target / "opt/mapquilt/agent/new.py").exists()
    assert not (target / "opt/mapquilt/agent/gone.py").exists()


def test_uninstalling_leaves_settings_and_purging_leaves_nothing(source: Path, target: Path) -> None:
    install(source, "--root", target)
    done = install(source, "--root", target, "--uninstall")
    assert "are kept (--purge removes them)" in done.stdout
    assert set(files(target)) == {"etc/mapquilt/robot.toml", "etc/mapquilt/robot.toml.sample"}
    install(source, "--root", target, "--uninstall", "--purge")
    assert files(target) == {}
    assert install(source, "--root", target, "--uninstall").returncode == 0


def test_a_wheelhouse_is_the_only_source_of_packages(source: Path, target: Path, tmp_path: Path) -> None:
    house = tmp_path / "wheels"
    house.mkdir()
    refused = install(source, "--root", target, "--wheelhouse", house)
    assert refused.returncode == 4
    assert "holds no .whl files; make it with: deploy/wheelhouse.sh" in refused.stderr
    (house / "a.whl").touch()
    assert f"find-links {house}" in install(source, "--root", target, "--wheelhouse", house).stdout


def test_an_update_whose_packages_fail_leaves_the_version_of_before(source: Path, target: Path) -> None:
    install(source, "--root", target)
    before = files(target)
    (source / "agent" / "new.py").write_text("")
    (source / "requirements.lock").write_text("msgpack==99")
    (source / "run").write_text("#!/bin/sh\nexit 3\n")
    done = install(source, "--root", target)
    assert done.returncode == 3
    assert "the version of before is in place again" in done.stderr
    assert files(target) == before


def test_a_folder_that_is_not_there_is_said(source: Path, target: Path) -> None:
    for option in ("--wheelhouse", "--keys"):
        done = install(source, "--root", target, option, target / "no" / "such")
        assert (done.returncode, done.stderr) == (4, f"mapquilt: {option} {target}/no/such: no such directory\n")


def test_keys_are_for_the_service_only(source: Path, target: Path, tmp_path: Path) -> None:
    bundle = tmp_path / "robot-1"
    bundle.mkdir()
    refused = install(source, "--root", target, "--keys", bundle)
    assert refused.returncode == 4
    assert "holds no fleet.key" in refused.stderr
    for name in ("fleet.key", "robot-1.key"):
        (bundle / name).write_text(name)
    assert install(source, "--root", target, "--keys", bundle).returncode == 0
    placed = sorted((target / "etc/mapquilt/fleet").iterdir())
    assert [(path.name, path.read_text(), path.stat().st_mode & 0o777) for path in placed] == [
        ("fleet.key", "fleet.key", 0o640),
        ("robot-1.key", "robot-1.key", 0o640),
    ]


def test_mistakes_are_told(source: Path, target: Path) -> None:
    for words, said in (
        (["--rot", target], "unknown option --rot"),
        (["--root", target, "--robot", "R 2"], "--robot 'R 2': use a-z"),
        (["--root", target, "--robot", "-x"], "use a-z"),
    ):
        done = install(source, *words)
        assert done.returncode == 2
        assert said in done.stderr
    assert files(target) == {}
    assert "sudo deploy/install.sh" in install(source, "--help").stdout


@pytest.mark.skipif(os.geteuid() == 0, reason="root may install, so the refusal of everybody else cannot be shown as root")
def test_it_asks_for_root(source: Path) -> None:
    done = install(source)
    assert done.returncode == 3
    assert "this needs root: sudo" in done.stderr
