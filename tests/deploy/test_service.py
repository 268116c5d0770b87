"""The systemd unit and the udev rules: what they promise, judged by systemd itself where it is at hand."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from agent.cli import command_parser
from agent.config import Config
from agent.config_sources import load_config

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"
UNIT = DEPLOY / "mapquilt@.service"
MDWE = """
import ctypes, sys
PR_SET_MDWE, REFUSE_EXEC_GAIN = 65, 1
if ctypes.CDLL(None, use_errno=True).prctl(PR_SET_MDWE, REFUSE_EXEC_GAIN, 0, 0, 0):
    sys.exit(77)
import cv2, msgpack, numpy, serial, zenoh
import agent.commands.run
image = numpy.zeros((64, 64), numpy.uint8)
image[20] = 255
assert cv2.HoughLinesP(image, 1, 0.01, 20) is not None
numpy.linalg.svd(numpy.random.default_rng(0).normal(size=(50, 50)))
numpy.fft.rfft2(image.astype(float))
loopback = '{listen: {endpoints: ["tcp/127.0.0.1:0"]}, scouting: {multicast: {enabled: false}}}'
with zenoh.open(zenoh.Config.from_json5(loopback)):
    print("works")
"""


def settings(text: str) -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for name, value in re.findall(r"(?m)^(\w+)=(.*)$", text):
        found.setdefault(name, []).append(value)
    return found


def test_the_service_is_hardly_exposed() -> None:
    analyze = shutil.which("systemd-analyze")
    if analyze is None:
        pytest.skip("systemd-analyze is not here: apt-get install systemd")
    asked = [analyze, "security", "--offline=true", "--threshold=20", "--no-pager", str(UNIT)]
    done = subprocess.run(asked, capture_output=True, text=True, check=False)
    exposure = re.search(r"exposure level.*?: ([\d.]+)", done.stdout)
    assert exposure, done.stdout + done.stderr
    assert float(exposure[1]) <= 2.0
    assert done.returncode == 0


def test_no_group_has_the_name_of_the_services_own_user() -> None:
    """systemd names a template's dynamic user after what stands before the @, and fails with 217/USER beside such a group."""
    groups = settings(UNIT.read_text())["SupplementaryGroups"][0].split()
    assert groups == ["dialout", "mapquilt-keys"]
    assert "\ngroup=mapquilt-keys\n" in (DEPLOY / "install.sh").read_text()


def test_a_robot_never_gives_up_and_is_watched() -> None:
    unit = settings(UNIT.read_text())
    assert unit["Type"] == ["notify"]
    assert unit["Restart"] == ["always"]
    assert unit["StartLimitIntervalSec"] == ["0"]
    assert unit["WatchdogSignal"] == ["SIGABRT"]
    assert float(unit["WatchdogSec"][0]) >= 4  # twice what the slowest feeder needs, and then some


def test_the_service_starts_the_installed_command_with_the_installed_settings() -> None:
    words = settings(UNIT.read_text())["ExecStart"][0].split()
    installer = (DEPLOY / "install.sh").read_text()
    assert words[0] == "/opt/mapquilt/.venv/bin/mapquilt"
    assert "home=$root/opt/mapquilt" in installer
    assert "settings=$root/etc/mapquilt" in installer
    args = command_parser(words[1]).parse_args(words[2:])
    assert args.config == "/etc/mapquilt/robot.toml"
    assert args.setting_robot_id == "%i"


def test_everything_runs_without_writable_and_executable_memory() -> None:
    done = subprocess.run([sys.executable, "-c", MDWE], capture_output=True, text=True, check=False, timeout=60)
    if done.returncode == 77:
        pytest.skip("this kernel has no PR_SET_MDWE (6.3 and newer do)")
    assert (done.stdout, done.returncode) == ("works\n", 0), done.stderr


def test_the_rules_open_ports_to_dialout_only() -> None:
    lines = [line for line in (DEPLOY / "90-mapquilt.rules").read_text().splitlines() if line and not line.startswith("#")]
    for line in lines:
        for part in re.split(r",\s*", line):
            assert re.fullmatch(r'[A-Z_]+(\{\w+\})?(==|!=|\+=|=)"[^"]*"', part), part
    modes = re.findall(r'MODE="(\d+)"', "\n".join(lines))
    assert modes == ["0660"]
    assert 'GROUP="dialout"' in lines[-2]
    assert 'ENV{ID_MM_DEVICE_IGNORE}="1"' in lines[-2]


def test_the_sample_settings_are_valid_and_name_real_settings() -> None:
    sample = DEPLOY / "robot.toml"
    assert load_config(sample, environ={}).config.fleet.security == "shared"


def test_what_is_commented_out_in_the_sample_is_the_default(tmp_path: Path) -> None:
    active = re.compile(r"(?m)^\w+ = .*$")
    text = re.sub(r"(?m)^# (?=\w+ = )", "", active.sub("", (DEPLOY / "robot.toml").read_text()))
    file = tmp_path / "defaults.toml"
    file.write_text(text)
    defaults = dict(Config().items())
    differing = {name for name, value in load_config(file, environ={}).config.items() if value != defaults[name]}
    assert differing == {"robot.id", "fleet.listen", "fleet.connect"}  # empty by default: the sample shows what they look like
