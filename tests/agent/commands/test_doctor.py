"""The doctor finds what is wrong, says how to mend it, and finds nothing on a sound machine."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import socket
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from agent.commands import doctor_checks as checks
from agent.commands.doctor_findings import Check, Finding, Level, Machine
from agent.config import Config, FleetConfig, LidarConfig, RobotConfig, StateConfig, ViewConfig
from tests.agent.commands.conftest import FakeRobot, Run


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    """A small file system to break."""
    for folder in ("dev", "proc/1", "sys", "home", "etc"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "proc/meminfo").write_text("MemTotal: 4000000 kB\nMemAvailable: 3000000 kB\n")
    config = Config(robot=RobotConfig("r1"), view=ViewConfig(port=0))
    return Machine(config, {"HOME": str(tmp_path / "home"), "XDG_RUNTIME_DIR": str(tmp_path / "run")}, tmp_path)


def changed(machine: Machine, **sections: object) -> Machine:
    return dataclasses.replace(machine, config=dataclasses.replace(machine.config, **sections))  # type: ignore[arg-type]


def only(check: Check, machine: Machine) -> Finding:
    [finding] = check(machine)
    return finding


def test_a_sound_machine_has_nothing_wrong(machine: Machine) -> None:
    found = [finding for check in checks.CHECKS for finding in check(machine)]
    assert {finding.level for finding in found} == {Level.OK}
    assert {finding.what for finding in found} >= {"python", "packages", "memory", "state", "security"}


def test_whatever_is_wrong_comes_with_a_command(machine: Machine) -> None:
    (machine.root / "proc/meminfo").write_text("MemAvailable: 100000 kB\n")
    finding = only(checks.memory, machine)
    assert (finding.level, finding.finding) == (Level.WARN, "97 MB free; a robot takes up to 300")
    assert finding.mend


def test_missing_packages_and_an_old_python(machine: Machine, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None if name == "serial" else object())
    assert only(checks.packages, machine).finding == "missing: pyserial"
    monkeypatch.setattr(checks, "PYTHONS", ((3, 99), (3, 99)))
    assert only(checks.python, machine).level is Level.FAIL


def test_low_voltage_is_seen_on_a_pi(machine: Machine) -> None:
    assert list(checks.power(machine)) == []
    book = machine.root / checks.THROTTLED
    book.parent.mkdir(parents=True)
    for text, level in (("0\n", Level.OK), ("50000\n", Level.WARN), ("50005\n", Level.WARN)):
        book.write_text(text)
        assert only(checks.power, machine).level is level


def test_a_port_that_may_not_be_opened(machine: Machine, monkeypatch: pytest.MonkeyPatch) -> None:
    (machine.root / "dev/ttyUSB0").touch()
    assert only(checks.serial_ports, machine).level is Level.OK
    monkeypatch.setattr(os, "access", lambda *_: False)
    finding = only(checks.serial_ports, machine)
    assert (finding.level, finding.mend) == (Level.FAIL, "sudo usermod -aG dialout pi  (then log in again)")
    finding = only(checks.serial_ports, dataclasses.replace(machine, groups=frozenset({"dialout"})))
    assert "90-mapquilt.rules" in finding.mend


def test_a_lidar_that_is_not_plugged_in(machine: Machine) -> None:
    asked = changed(machine, lidar=LidarConfig(url="ld06:/dev/ttyUSB7?baud=230400"))
    finding = only(checks.serial_ports, asked)
    assert (finding.what, finding.level, finding.mend) == ("lidar", Level.FAIL, "mapquilt devices")
    (machine.root / "dev/ttyUSB7").touch()
    assert only(checks.serial_ports, asked).level is Level.OK
    assert list(checks.serial_ports(changed(machine, lidar=LidarConfig(url="sim:office")))) == [
        checks.ok("port", str(machine.root / "dev/ttyUSB7"))
    ]


def test_daemons_that_steal_ports(machine: Machine) -> None:
    (machine.root / "proc/1/comm").write_text("brltty\n")
    assert only(checks.port_thieves, machine).mend == "sudo apt-get remove brltty"
    (machine.root / "proc/1/comm").write_text("ModemManager\n")
    assert only(checks.port_thieves, machine).level is Level.WARN
    rules = machine.root / "etc/udev/rules.d"
    rules.mkdir(parents=True)
    (rules / "90-mapquilt.rules").touch()  # they tell ModemManager to keep off
    assert list(checks.port_thieves(machine)) == []


def test_a_state_directory_that_cannot_be_written(machine: Machine, monkeypatch: pytest.MonkeyPatch) -> None:
    there = machine.root / "home"
    asked = changed(machine, state=StateConfig(dir=str(there / "not/yet/there")))
    assert only(checks.state, asked).level is Level.OK
    monkeypatch.setattr(checks, "DISK_MB", 10**12)
    assert only(checks.state, asked).level is Level.WARN
    monkeypatch.setattr(os, "access", lambda *_: False)
    assert only(checks.state, asked).finding == f"{there} cannot be written: maps would be lost"
    assert only(checks.state, asked).mend == f"sudo chown pi {there}"
    owned = dataclasses.replace(asked, user=there.owner())
    assert only(checks.state, owned).mend == f"chmod u+rwx {there}"  # one's own folder, and a chown changes nothing


def test_a_page_whose_port_is_taken(machine: Machine, robot: Callable[..., FakeRobot]) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        asked = changed(machine, view=ViewConfig(port=taken.getsockname()[1]))
        finding = only(checks.view, asked)
        assert finding.level is Level.WARN
        assert "in use" in finding.finding
        robot("r1")  # it is our own robot that has it
        assert list(checks.view(asked)) == []


def test_a_lan_needs_multicast(machine: Machine) -> None:
    assert list(checks.network(machine)) == []
    lan = changed(machine, fleet=FleetConfig(profile="lan"))
    for name, flags in (("lo", "0x49"), ("wlan0", "0x1002"), ("eth0", "0x1003")):
        (machine.root / "sys/class/net" / name).mkdir(parents=True)
        (machine.root / "sys/class/net" / name / "flags").write_text(flags + "\n")
        assert only(checks.network, lan).level is (Level.OK if name == "eth0" else Level.WARN)
    (machine.root / "sys/class/net/eth0/flags").write_text("0x0\n")
    dialled = changed(machine, fleet=FleetConfig(profile="lan", connect=("tcp/10.0.0.1:7447",)))
    assert only(checks.network, dialled).level is Level.OK


def test_security_that_is_none(machine: Machine) -> None:
    assert only(checks.security, machine).level is Level.OK
    assert only(checks.security, changed(machine, fleet=FleetConfig(profile="lan"))).level is Level.WARN


def test_a_key_must_be_there_and_private(machine: Machine) -> None:
    key = machine.root / "fleet.key"
    asked = changed(machine, fleet=FleetConfig(security="shared", key_file=str(key)))
    assert only(checks.security, asked).level is Level.FAIL
    key.touch(mode=0o600)
    assert only(checks.security, asked).level is Level.OK
    key.chmod(0o644)
    finding = only(checks.security, asked)
    assert (finding.level, finding.mend) == (Level.FAIL, f"chmod o-rwx {key}")


def test_certificates_are_looked_at_before_they_expire(machine: Machine) -> None:
    openssl = shutil.which("openssl")
    if openssl is None:
        pytest.skip("openssl is not here to make certificates with")
    for name, days in (("ca", 400), ("r1", 10)):
        made = [openssl, "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes", "-days", str(days)]
        made += ["-subj", "/CN=x", "-keyout", f"{machine.root}/{name}.key", "-out", f"{machine.root}/{name}.pem"]
        subprocess.run(made, check=True, capture_output=True)
    asked = changed(machine, fleet=FleetConfig(security="mtls", certificates=str(machine.root)))
    key, authority, own = checks.security(asked)
    assert (key.level, authority.level, own.level) == (Level.OK, Level.OK, Level.WARN)
    assert "expires on" in own.finding
    (machine.root / "r1.pem").write_text("nonsense")
    assert list(checks.security(asked))[2].level is Level.FAIL
    (machine.root / "ca.pem").unlink()
    assert "no such certificate" in list(checks.security(asked))[1].finding


def test_the_problems_of_a_running_robot_are_told(machine: Machine, robot: Callable[..., FakeRobot]) -> None:
    assert list(checks.running_robot(machine)) == []
    sick = robot("r1")
    assert only(checks.running_robot, machine).finding == "r1: wheels wheels:/dev/ttyACM0: no such port"
    sick.server.close()
    sick.server.path.touch()
    assert "does not answer" in only(checks.running_robot, machine).finding
    sick.server.path.unlink()
    robot("r1", problems=[])
    assert only(checks.running_robot, machine).level is Level.OK


def test_the_command_tells_everything_and_ends_with_1_when_something_failed(run: Run, tmp_path: Path) -> None:
    ended = run("doctor", "--set", "view.port=0", "--id", "r1")
    assert ended.code in (0, 1)  # what else is wrong with this machine is not ours to say
    assert ended.out.splitlines()[0].startswith("OK    settings  ")
    file = tmp_path / "robot.toml"
    file.write_text("[fleet]\nsecurity = 'shared'\nkey_file = '/none'\n")
    ended = run("doctor", "--config", file, "--json", "--set", "view.port=0")
    assert ended.code == 1
    found = [json.loads(line) for line in ended.out.splitlines()]
    assert {
        "level": "FAIL",
        "what": "security",
        "finding": "fleet key /none: No such file or directory",
        "mend": "cp keys/fleet.key /none  (made once, for all robots: mapquilt fleet init keys)",
    } in found


def test_what_mends_settings_is_where_the_mistake_was_made(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "my robot.toml").write_text("[lidr]\nurl = 1\n")
    assert f"mend: nano '{tmp_path}/my robot.toml'\n" in run("doctor", "--config", tmp_path / "my robot.toml").out
    assert "mend: mapquilt doctor --help\n" in run("doctor", "--view-port", "x").out
    monkeypatch.setenv("MAPQUILT_LIDAR__ULR", "x")
    assert "mend: unset MAPQUILT_LIDAR__ULR\n" in run("doctor").out


def test_settings_that_cannot_be_read_are_a_finding(run: Run, tmp_path: Path) -> None:
    (tmp_path / "robot.toml").write_text("[mapping]\nparticels = 3\n")
    ended = run("doctor", "--config", tmp_path / "robot.toml", "-q")
    assert ended.code == 1
    assert ended.out.startswith("FAIL  settings ")
    assert "did you mean 'mapping.particles'?" in ended.out
