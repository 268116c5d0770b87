"""What can be wrong with a machine, one check each: a finding, and the one command that mends it.

Checks look at a `Machine`, so that tests can show them broken ones; nothing is changed and nothing is opened for writing.
"""

from __future__ import annotations

import enum
import importlib.util
import os
import platform
import shutil
import socket
import stat
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from agent.config import Config, control_socket, state_dir
from agent.running import running_robots
from agent.runtime.control import ControlError, ask

PACKAGES = {
    "zenoh": "eclipse-zenoh",
    "numpy": "numpy",
    "cv2": "opencv-python-headless",
    "msgpack": "msgpack",
    "serial": "pyserial",
}
PYTHONS = ((3, 11), (3, 14))
MEMORY_MB, DISK_MB, FILES = 300, 200, 256  # measured needs of one robot (150 MB and 60 descriptors), with room
PORT_THIEVES = {  # program: why it must not be there
    "ModemManager": ("sends modem commands to every new port", "sudo systemctl disable --now ModemManager"),
    "brltty": ("takes CP210x and CH340 adapters for braille displays", "sudo apt-get remove brltty"),
}
IFF_UP, IFF_MULTICAST = 0x1, 0x1000
THROTTLED = Path("sys/devices/platform/soc/soc:firmware/get_throttled")
UNDERVOLTED_NOW, UNDERVOLTED_ONCE = 1 << 0, 1 << 16
EXPIRES_WITHIN_S = 30 * 24 * 3600


class Level(enum.Enum):
    OK = "OK"
    WARN = "WARN"
    FAIL = "FAIL"


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the doctor's report."""

    level: Level
    what: str
    finding: str
    mend: str = ""  # a command


@dataclass(frozen=True, slots=True)
class Machine:
    """What is looked at; `root` is where the file system begins."""

    config: Config
    environ: Mapping[str, str]
    root: Path = Path("/")
    groups: frozenset[str] = field(default_factory=frozenset)
    user: str = "pi"


Check = Callable[[Machine], Iterator[Finding]]


def ok(what: str, finding: str) -> Finding:
    return Finding(Level.OK, what, finding)


def python(machine: Machine) -> Iterator[Finding]:
    version, bits = sys.version_info[:2], 8 * struct.calcsize("P")
    text = f"{platform.python_version()}, {bits} bit, {platform.machine()}"
    if bits != 64:
        yield Finding(Level.FAIL, "python", f"{text}: packages are 64 bit only", "rpi-imager  (choose a 64-bit system)")
    elif not PYTHONS[0] <= version <= PYTHONS[1]:
        yield Finding(Level.FAIL, "python", f"{text}: 3.11 to 3.14 is needed", "python3 -m pip install --user uv && ./run")
    else:
        yield ok("python", text)


def packages(machine: Machine) -> Iterator[Finding]:
    missing = [name for module, name in PACKAGES.items() if importlib.util.find_spec(module) is None]
    if missing:
        yield Finding(Level.FAIL, "packages", f"missing: {', '.join(missing)}", "rm -rf .venv && ./run")
    else:
        yield ok("packages", ", ".join(PACKAGES.values()))


def memory(machine: Machine) -> Iterator[Finding]:
    lines = _read(machine.root / "proc/meminfo").splitlines()
    available = next((int(line.split()[1]) // 1024 for line in lines if line.startswith("MemAvailable:")), None)
    if available is None:
        return
    if available < MEMORY_MB:
        yield Finding(
            Level.WARN,
            "memory",
            f"{available} MB free; a robot takes up to {MEMORY_MB}",
            "sudo systemctl isolate multi-user.target",
        )
    else:
        yield ok("memory", f"{available} MB free")


def power(machine: Machine) -> Iterator[Finding]:
    """The Raspberry Pi's firmware keeps book of every drop."""
    text = _read(machine.root / THROTTLED).strip()
    if not text:
        return
    flags = int(text, 16)
    if flags & (UNDERVOLTED_NOW | UNDERVOLTED_ONCE):
        when = "now" if flags & UNDERVOLTED_NOW else "since the last start"
        yield Finding(
            Level.WARN, "power", f"the voltage is too low {when}: LIDAR motors need a strong supply", "vcgencmd get_throttled"
        )
    else:
        yield ok("power", "the voltage never dropped")


def state(machine: Machine) -> Iterator[Finding]:
    folder = state_dir(machine.config, machine.environ)
    there = next(path for path in (folder, *folder.parents) if path.exists())
    if not os.access(there, os.W_OK):
        yield Finding(Level.FAIL, "state", f"{there} cannot be written: maps would be lost", f"sudo chown {machine.user} {there}")
        return
    free_mb = shutil.disk_usage(there).free // 2**20
    if free_mb < DISK_MB:
        yield Finding(Level.WARN, "state", f"{folder}: {free_mb} MB free on this disk", "sudo apt-get clean")
    else:
        yield ok("state", f"{folder} ({free_mb} MB free)")


def descriptors(machine: Machine) -> Iterator[Finding]:
    import resource  # noqa: PLC0415  Linux only, like this check

    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    if 0 <= soft < FILES:
        yield Finding(Level.WARN, "files", f"only {soft} open files are allowed", "ulimit -n 1024")


def serial_ports(machine: Machine) -> Iterator[Finding]:
    """Every port there is: may this user open it?  And the ports that the settings name: are they there?"""
    dev = machine.root / "dev"
    for path in sorted([*dev.glob("ttyUSB*"), *dev.glob("ttyACM*"), *dev.glob("ttyAMA*")]):
        if os.access(path, os.R_OK | os.W_OK):
            yield ok("port", str(path))
        elif "dialout" in machine.groups:
            yield Finding(
                Level.FAIL,
                "port",
                f"{path} may not be opened",
                "sudo cp deploy/90-mapquilt.rules /etc/udev/rules.d/ && sudo udevadm trigger",
            )
        else:
            yield Finding(
                Level.FAIL,
                "port",
                f"{path}: {machine.user} is not in the group dialout",
                f"sudo usermod -aG dialout {machine.user}  (then log in again)",
            )
    for name, url in (("lidar", machine.config.lidar.url), ("wheels", machine.config.wheels.url)):
        path = machine.root / url.partition(":")[2].partition("?")[0].lstrip("/")
        if url.partition(":")[2].startswith("/dev/") and not path.exists():
            yield Finding(Level.FAIL, name, f"{url}: nothing is plugged in there", "mapquilt devices")


def port_thieves(machine: Machine) -> Iterator[Finding]:
    """Daemons that open every new serial port before anybody else does."""
    running = {_read(path).strip() for path in (machine.root / "proc").glob("[0-9]*/comm")}
    rules = (machine.root / "etc/udev/rules.d/90-mapquilt.rules").exists()
    for program, (why, mend) in PORT_THIEVES.items():
        if program in running and not (program == "ModemManager" and rules):
            yield Finding(Level.WARN, "ports", f"{program} runs, and {why}", mend)


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
        yield _private_file("security", "fleet key", fleet.key_file)
    else:
        folder = Path(fleet.certificates)
        yield _private_file("security", "private key", str(folder / f"{machine.config.robot.id}.key"))
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


CHECKS: tuple[Check, ...] = (
    python, packages, memory, power, descriptors, state, serial_ports, port_thieves, network, view, security, running_robot,
)  # fmt: skip


def _private_file(what: str, name: str, path: str) -> Finding:
    try:
        mode = Path(path).stat().st_mode
    except OSError as error:
        return Finding(Level.FAIL, what, f"{name} {path or '(none given)'}: {error.strerror}", "mapquilt fleet init keys")
    if mode & stat.S_IRWXO:
        return Finding(Level.FAIL, what, f"{name} {path} can be read by everybody", f"chmod o-rwx {path}")
    if not os.access(path, os.R_OK):
        return Finding(
            Level.WARN, what, f"{name} {path} cannot be read by this user", f"sudo -u {Path(path).owner()} mapquilt doctor"
        )
    return ok(what, f"{name} {path}")


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
    return int(_read(path).strip() or "0", 16)


def _read(path: Path) -> str:
    try:
        return path.read_text(errors="replace")
    except OSError:
        return ""
