"""Opens devices by URL: `open_lidar("ld06:/dev/ttyUSB0")`, `open_wheels("wheels:/dev/ttyACM0")`, then `start()` and `read()`.

A URL that can never work raises `DeviceConfigError` here; afterwards a device never raises, see `supervisor.py`.  Sources
that are no serial device (simulated worlds, recordings) register a scheme of their own with `register_scheme`.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from typing import Protocol

from hw.driver import Driver, Reading
from hw.errors import DeviceConfigError
from hw.health import DeviceHealth, DeviceState
from hw.lidars import LIDARS
from hw.port import SerialPort
from hw.supervisor import Device
from hw.urls import DeviceUrl, parse_url
from hw.wheel_driver import BASES

__all__ = [
    "Device",
    "DeviceHealth",
    "DeviceState",
    "Source",
    "build_driver",
    "open_lidar",
    "open_wheels",
    "register_scheme",
    "schemes",
]


class Source(Protocol):
    """What `open_lidar` and `open_wheels` return; `Device` is the usual one."""

    def start(self) -> Source: ...

    def stop(self) -> None: ...

    def read(self, timeout_s: float) -> Reading | None: ...

    def health(self) -> DeviceHealth: ...


Factory = Callable[[DeviceUrl, str], Source]  # (url, "lidar" | "wheels")

_factories: dict[str, Factory] = {}
_on_demand = {
    "sim": "hw.sim.sim_port",
    "log": "hw.sim.replay_port",
    "replay": "hw.recorder",
}  # modules that register their scheme


def register_scheme(scheme: str, factory: Factory) -> None:
    """Make `scheme:...` a device URL."""
    _factories[scheme] = factory


def open_lidar(url: str) -> Source:
    """A LIDAR by its URL; not yet started."""
    return _open(url, "lidar")


def open_wheels(url: str) -> Source:
    """A wheel base by its URL; not yet started."""
    return _open(url, "wheels")


def schemes(kind: str) -> list[str]:
    """The URL schemes of serial devices, "lidar" or "wheels"."""
    return sorted(LIDARS if kind == "lidar" else BASES)


def build_driver(url: DeviceUrl, kind: str) -> Driver:
    """The driver a URL names, without its port."""
    drivers: Mapping[str, Callable[[DeviceUrl], Driver]] = LIDARS if kind == "lidar" else BASES
    if url.scheme not in drivers:
        known = ", ".join(sorted({*drivers, *_factories, *_on_demand}))
        right = {**dict.fromkeys(LIDARS, "a LIDAR: --lidar"), **dict.fromkeys(BASES, "a wheel base: --wheels")}.get(url.scheme)
        hint = f"it is {right} {url.text}" if right else f"there are {known}"
        raise DeviceConfigError(f"{url.text}: '{url.scheme}' is no kind of {kind}; {hint}")
    driver = drivers[url.scheme](url)
    if "baud" in url.options:
        driver.bauds = (url.integer("baud", 0, 300, 4_000_000),)
    return driver


def _open(text: str, kind: str) -> Source:
    url = parse_url(text)
    if url.scheme in _on_demand and url.scheme not in _factories:
        importlib.import_module(_on_demand[url.scheme])
    if url.scheme in _factories:
        return _factories[url.scheme](url, kind)
    driver = build_driver(url, kind)
    if not url.path:
        raise DeviceConfigError(f"{text}: which port? for example {url.scheme}:/dev/ttyUSB0")
    return Device(text, driver, lambda baud, dtr: SerialPort(url.path, baud, dtr), url.path)
