"""What can be wrong with a robot's surroundings: its page's port, its network, its keys, and the robot itself when it runs."""

from __future__ import annotations

import os
import shlex
import shutil
import socket
import stat
import subprocess
from collections.abc import Iterator
from pathlib import Path

from agent.commands.doctor_findings import Finding, Level, Machine, ok, text_of
from agent.config import control_socket
from agent.running import running_robots
from agent.runtime.control import ControlError, ask

IFF_UP, IFF_MULTICAST = 0x1, 0x1000
EXPIRES_WITHIN_S = 30 * 24 * 3600


def view(machine: Machine) -> Iterator[Finding]:
    settings = machine.config.view
    if not settings.enabled or settings.port == 0 or _socket_of(machine).exists():
        return  # no page, any port, or our own robot has it
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((settings.host, settings.port))
        except OSError as error:
            why = error.strerror or str(error)
            yield Finding(
                Level.WARN,
                "page",
                f"{settings.host}:{settings.port}: {why}; the next free port is taken",
                f"ss -ltnp 'sport = {settings.port}'",
            )
            return
    yield ok("page", f"{settings.host}:{settings.port} is free")


def network(machine: Machine) -> Iterator[Finding]:
    """Robots on one LAN find one another by multicast."""
    if machine.config.fleet.profile != "lan":
        return
    interfaces = {path.parent.name: _flags(path) for path in (machine.root / "sys/class/net").glob("*/flags")}
    able = sorted(name for name, flags in interfaces.items() if flags & IFF_UP and flags & IFF_MULTICAST and name != "lo")
    if able:
        yield ok("network", f"multicast over {', '.join(able)}")
    elif machine.config.fleet.connect:
        yield ok("network", f"no multicast, so only {', '.join(machine.config.fleet.connect)} are dialled")
    else:
        yield Finding(
            Level.WARN, "network", "no network interface can multicast: robots will not find one another", "ip link show up"
        )


def security(machine: Machine) -> Iterator[Finding]:
    fleet = machine.config.fleet
    if fleet.security == "open":
        if fleet.profile == "loopback":
            yield ok("security", "open, and nothing leaves this machine")
        else:
            yield Finding(
                Level.WARN,
                "security",
                f"open on profile {fleet.profile}: anybody on the network can send maps",
                "mapquilt fleet init keys",
            )
    elif fleet.security == "shared":
        path = shlex.quote(fleet.key_file)
        mend = f"cp keys/fleet.key {path}  (made once, for all robots: mapquilt fleet init keys)"
        yield _private_file("fleet key", fleet.key_file, mend if fleet.key_file else "mapquilt fleet init keys")
    else:
        folder = Path(fleet.certificates)
        robot = machine.config.robot.id
        mend = f"mapquilt fleet enroll keys {robot} && cp keys/bundles/{robot}/* {shlex.quote(str(folder))}"
        yield _private_file("private key", str(folder / f"{robot}.key"), mend)
        for name in ("ca.pem", f"{machine.config.robot.id}.pem"):
            yield _certificate(folder / name)


def running_robot(machine: Machine) -> Iterator[Finding]:
    robot = machine.config.robot.id
    path = _socket_of(machine)
    if not path.exists():
        return
    try:
        status = ask(path, "status")["status"]
    except ControlError as error:
        yield Finding(
            Level.WARN, "robot", f"{robot} left {path} behind and does not answer: {error}", f"mapquilt run --id {robot}"
        )
        return
    for problem in status.get("problems", []):
        yield Finding(Level.WARN, "robot", f"{robot}: {problem}", f"mapquilt status --robot {robot}")
    if not status.get("problems"):
        yield ok("robot", f"{robot} runs, and has nothing to complain about")


def _socket_of(machine: Machine) -> Path:
    """Of the running robot, also when it is a service; else where one of this user would be."""
    robot = machine.config.robot.id
    return running_robots(machine.environ).get(robot) or control_socket(robot, machine.environ)


def _private_file(name: str, path: str, mend: str) -> Finding:
    try:
        mode = Path(path).stat().st_mode
    except OSError as error:
        return Finding(Level.FAIL, "security", f"{name} {path or '(none given)'}: {error.strerror}", mend)
    if mode & stat.S_IRWXO:
        return Finding(Level.FAIL, "security", f"{name} {path} can be read by everybody", f"chmod o-rwx {shlex.quote(path)}")
    if not os.access(path, os.R_OK):
        return Finding(
            Level.WARN, "security", f"{name} {path} cannot be read by this user", f"sudo -u {Path(path).owner()} mapquilt doctor"
        )
    return ok("security", f"{name} {path}")


def _certificate(path: Path) -> Finding:
    if not path.is_file():
        return Finding(Level.FAIL, "security", f"{path}: no such certificate", "mapquilt fleet enroll keys ROBOT")
    openssl = shutil.which("openssl")
    if openssl is None:
        return ok("security", f"{path} (install openssl to see when it expires)")
    asked = [openssl, "x509", "-noout", "-enddate", "-checkend", str(EXPIRES_WITHIN_S), "-in", str(path)]
    done = subprocess.run(asked, capture_output=True, text=True, timeout=10, check=False)
    end = next((line.partition("=")[2] for line in done.stdout.splitlines() if line.startswith("notAfter=")), "")
    if not end:
        return Finding(Level.FAIL, "security", f"{path}: no certificate can be read from it", "mapquilt fleet enroll keys ROBOT")
    if done.returncode:
        return Finding(Level.WARN, "security", f"{path} expires on {end}", "mapquilt fleet enroll keys ROBOT")
    return ok("security", f"{path} is valid until {end}")


def _flags(path: Path) -> int:
    return int(text_of(path).strip() or "0", 16)
