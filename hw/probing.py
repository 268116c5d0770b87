"""Which serial ports there are, by the names that stay, and which sensor answers on each.

`/dev/ttyUSB0` is whoever was plugged in first; `/dev/serial/by-id` names the adapter, and cannot tell two of the same kind
with the same factory serial number apart; `/dev/serial/by-path` names the socket it is plugged into.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from hw.device import open_lidar, open_wheels
from hw.health import DeviceHealth
from hw.port import port_list, user_of

SERIAL_LINKS = Path("/dev/serial")
# silent listeners first: asking an unknown device may start something, and a streaming one tells within half a second
PROBE_URLS = (
    *("wheels", "ld06", "rplidar", "ydlidar", "hokuyo", "xv11", "kobuki"),
    *("create2", "arduino", "sick", "roboclaw", "stl27l", "lds01"),
)
ANY_GEOMETRY = {"arduino": "?ticks=1000&radius=0.05&track=0.3", "roboclaw": "?ticks=1000&radius=0.05&track=0.3"}  # they know none
WHEEL_SCHEMES = ("wheels", "kobuki", "create2", "arduino", "roboclaw")


@dataclass(frozen=True, slots=True)
class SerialPortInfo:
    """One port, under all its names."""

    device: str
    description: str = ""
    by_id: str = ""
    by_path: str = ""
    used_by: str = ""  # another process that has it open


@dataclass(frozen=True, slots=True)
class Answer:
    """Who answered on a port."""

    url: str
    kind: str  # "lidar" or "wheels"
    health: DeviceHealth

    @property
    def usage(self) -> str:
        """The URL to use, with what the device cannot tell of itself left to fill in."""
        scheme = self.url.partition(":")[0]
        return f"'{self.url}?ticks=...&radius=...&track=...'" if scheme in ANY_GEOMETRY else self.url


def serial_ports() -> list[SerialPortInfo]:
    """All serial ports of this computer."""
    by_id, by_path = _links("by-id"), _links("by-path")
    return [
        SerialPortInfo(device, description, by_id.get(device, ""), by_path.get(device, ""), user_of(device))
        for device, description in port_list()
    ]


def _links(folder: str) -> dict[str, str]:
    links = SERIAL_LINKS / folder
    return {os.path.realpath(link): str(link) for link in sorted(links.iterdir())} if links.is_dir() else {}


def probe(port: str, schemes: tuple[str, ...] = PROBE_URLS, seconds: float = 2.5) -> Answer | None:
    """Open the port as one kind of device after the other, until one sends a reading."""
    for scheme in schemes:
        answer = _try(scheme, port, seconds)
        if answer is not None:
            return answer
    return None


def _try(scheme: str, port: str, seconds: float) -> Answer | None:
    is_wheels = scheme in WHEEL_SCHEMES
    url = f"{scheme}:{port}"
    device = (open_wheels if is_wheels else open_lidar)(url + ANY_GEOMETRY.get(scheme, ""))
    device.start()
    try:
        for _ in _until(time.monotonic() + seconds):
            if device.read(0.1) is not None:
                return Answer(url, "wheels" if is_wheels else "lidar", device.health())
    finally:
        device.stop()
    return None


def _until(deadline_s: float) -> Iterator[None]:
    while time.monotonic() < deadline_s:
        yield
