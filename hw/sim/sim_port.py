"""Simulated devices plugged in inside this process: a device as a `Port`, for `sim:office?seed=3` and `log:run.clf`."""

from __future__ import annotations

import threading
import time

from hw.device import register_scheme
from hw.driver import Driver
from hw.errors import DeviceConfigError
from hw.ld06 import Ld06
from hw.sick_lms import SickLms
from hw.sim.catalogue import BASES, LIDARS
from hw.sim.devices import ByteDevice, SickScanner
from hw.sim.robot import SimulatedRobot
from hw.sim.sight import Sight
from hw.sim.world import open_world
from hw.supervisor import Device
from hw.urls import DeviceUrl
from hw.wheel_driver import WheelDriver
from hw.wheels import WheelBoard

TICK_S = 0.01  # how often a reader looks
REPLAY_V_MAX_MPS = 100.0  # a recording is driven faster than any robot


class SimPort:
    """A `Port` that is a simulated device."""

    def __init__(self, device: ByteDevice) -> None:
        self._device = device
        self._woken = threading.Event()

    def read(self, timeout_s: float) -> bytes:
        """See `Port.read`."""
        end_s = time.monotonic() + timeout_s
        while not (data := self._device.emit(time.monotonic())) and time.monotonic() < end_s:
            if self._woken.wait(TICK_S / 2):
                self._woken.clear()
                break
        return data

    def write(self, data: bytes) -> None:
        """See `Port.write`."""
        self._device.receive(data, time.monotonic())

    def set_baud(self, baud: int) -> None:
        """Any rate will do."""

    def set_lines(self, dtr: bool | None, rts: bool | None) -> None:
        """There are no lines."""

    def flush_input(self) -> None:
        """Throw away what was sent before."""
        self._device.emit(time.monotonic())

    def wake(self) -> None:
        """See `Port.wake`."""
        self._woken.set()

    def close(self) -> None:
        """Nothing to give back."""


_shared: dict[str, SimulatedRobot] = {}  # a LIDAR and a wheel board with the same URL sit on the same robot
_sharing = threading.Lock()


def _open_simulated(url: DeviceUrl, kind: str) -> Device:
    """`sim:office?seed=3&start=1`: the world, its seed, and which of its starts."""
    url.only(("seed", "start"))
    seed, start = url.integer("seed", 0), url.integer("start", 0, most=63)
    with _sharing:
        if url.text not in _shared:
            world = open_world(url.path if "seed" not in url.options else f"{url.path}?seed={seed}")
            robot = SimulatedRobot(world, world.start_poses(start + 1, seed)[start], 64 * seed + start)
            robot.begin()
            _shared[url.text] = robot
        robot = _shared[url.text]
    if kind == "lidar":
        return _device(url, Ld06(), LIDARS["ld06"][0](Sight(robot, seed=seed)))
    return _device(url, WheelDriver(WheelBoard(), "simulated wheels"), BASES["wt1"].make(robot))


def _device(url: DeviceUrl, driver: Driver, simulated: ByteDevice) -> Device:
    return Device(url.text, driver, lambda baud, dtr: SimPort(simulated), url.text)


def replay_device(url: DeviceUrl, kind: str, scanner: SickScanner, board: ByteDevice) -> Device:
    """The LIDAR or the wheels of a recording, as a device inside this process."""
    if kind == "lidar":
        return _device(url, SickLms(SickScanner.baud), scanner)
    if kind == "wheels":
        return _device(url, WheelDriver(WheelBoard(None, REPLAY_V_MAX_MPS), "recorded wheels"), board)
    raise DeviceConfigError(f"{url.text}: a recording has a lidar and wheels, no {kind}")


register_scheme("sim", _open_simulated)
