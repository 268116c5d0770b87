"""What can be wrong with a machine, one check each: a finding, and the one command that mends it.

Checks look at a `Machine`, so that tests can show them broken ones; nothing is changed and nothing is opened for writing.
"""

from __future__ import annotations

import importlib.util
import os
import platform
import shutil
import struct
import sys
from collections.abc import Iterator
from pathlib import Path

from agent.commands.doctor_findings import Check, Finding, Level, Machine, ok, text_of
from agent.commands.doctor_robot import network, running_robot, security, view
from agent.config import state_dir

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
THROTTLED = Path("sys/devices/platform/soc/soc:firmware/get_throttled")
UNDERVOLTED_NOW, UNDERVOLTED_ONCE = 1 << 0, 1 << 16


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
    lines = text_of(machine.root / "proc/meminfo").splitlines()
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
    text = text_of(machine.root / THROTTLED).strip()
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
        yield Finding(Level.FAIL, "state", f"{there} cannot be written: maps would be lost", _made_writable(there, machine.user))
        return
    free_mb = shutil.disk_usage(there).free // 2**20
    if free_mb < DISK_MB:
        yield Finding(Level.WARN, "state", f"{folder}: {free_mb} MB free on this disk", "sudo apt-get clean")
    else:
        yield ok("state", f"{folder} ({free_mb} MB free)")


def _made_writable(folder: Path, user: str) -> str:
    if os.statvfs(folder).f_flag & os.ST_RDONLY:
        mount = next(path for path in (folder, *folder.parents) if path.is_mount())
        return f"sudo mount -o remount,rw {mount}"
    return f"chmod u+rwx {folder}" if folder.owner() == user else f"sudo chown {user} {folder}"


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
    running = {text_of(path).strip() for path in (machine.root / "proc").glob("[0-9]*/comm")}
    rules = (machine.root / "etc/udev/rules.d/90-mapquilt.rules").exists()
    for program, (why, mend) in PORT_THIEVES.items():
        if program in running and not (program == "ModemManager" and rules):
            yield Finding(Level.WARN, "ports", f"{program} runs, and {why}", mend)


CHECKS: tuple[Check, ...] = (
    python, packages, memory, power, descriptors, state, serial_ports, port_thieves, network, view, security, running_robot,
)  # fmt: skip
