"""A serial device that breaks on purpose: any simulated device on a real pty, with a seeded schedule of faults.

    with SerialDevice("ld06", tmp_path / "lidar", "stall@2:1,unplug@5:1", seed=7) as device:
        ... open_lidar(device.url) ...
        device.inject("drop", 30)              a fault now
        device.silence(); device.pull()        until device.relieve()
        device.steal()                         a second program reads from the same port
        device.path()                          the pts behind the link: another one after a replug

What can go wrong is listed in `hw/sim/faults.py`; the device stands in a room with known walls, without noise, so that every
range a driver hands on can be judged.
"""

from __future__ import annotations

import contextlib
import math
import os
from pathlib import Path

import numpy as np

from hw.readings import LaserScan
from hw.sim.catalogue import BASES, LIDARS, device_url
from hw.sim.faults import FaultyDevice, Schedule
from hw.sim.obedient import ObedientRobot
from hw.sim.pty_port import PtyServer
from hw.sim.raycast import cast_all
from hw.sim.sight import Sight
from hw.sim.world import World
from protocol.geometry import SE2

ROOM = World.parse("0 0 4.1 0\n4.1 0 4.1 3.3\n4.1 3.3 0.6 3.3\n0.6 3.3 0 2.6\n0 2.6 0 0\n2.8 2.0 3.2 2.0\n3.2 2 3 2.3", "room")
POSE = SE2(1.3, 1.1, math.radians(35))
FOR_EVER_S = 1e8


class SerialDevice:
    """One device of the catalogue, served until the `with` ends."""

    def __init__(self, name: str, link: Path, faults: str = "", seed: int = 0, wheels: object = None) -> None:
        self.name, self.link = name, link
        sight = Sight(ObedientRobot(ROOM, POSE), noise_m=0.0, seed=seed)
        device = LIDARS[name][0](sight) if name in LIDARS else BASES[name].make(wheels or Bend(name))  # type: ignore[arg-type]
        self.faulty = FaultyDevice(device, Schedule.parse(faults), seed)
        self._server = PtyServer([(self.faulty, link)])

    def __enter__(self) -> SerialDevice:
        self._server.__enter__()
        return self

    def __exit__(self, *exc: object) -> None:
        self._server.__exit__(*exc)

    @property
    def url(self) -> str:
        """What a robot opens."""
        return device_url(self.name, self.link)

    def path(self) -> str:
        """The pts behind the link; "" while unplugged."""
        with contextlib.suppress(OSError):
            return os.readlink(self.link)
        return ""

    def inject(self, kind: str, value: float | None = None) -> None:
        """A fault that is due now."""
        self.faulty.inject(kind, value)

    def silence(self) -> None:
        """It says nothing, until `relieve`."""
        self.inject("stall", FOR_EVER_S)

    def pull(self) -> None:
        """Its cable is out, until `relieve`; then it is plugged in elsewhere."""
        self.inject("unplug", FOR_EVER_S)

    def relieve(self) -> None:
        """It speaks, and is plugged in."""
        self.faulty.relieve()

    def wear(self, flip_share: float) -> None:
        """From now on this share of its bytes has a turned bit."""
        self.faulty.wear(flip_share)

    def did(self, kind: str) -> int:
        """How often a kind of fault has happened."""
        return sum(fault.kind == kind for fault in list(self.faulty.done))

    def steal(self, n_bytes: int = 4096) -> int:
        """A second program opens the port and takes what it can get; the answer is how many bytes that was."""
        fd = os.open(self.link, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY)
        try:
            return len(os.read(fd, n_bytes))
        except BlockingIOError:
            return 0
        finally:
            os.close(fd)


class Bend:
    """Wheels of a base on a wide left-hand bend, 0.3 m/s and 0.2 rad/s, counted from the moment they are first asked."""

    speed_mps, turn_rad_s = 0.3, 0.2

    def __init__(self, name: str) -> None:
        drive = BASES[name].drive
        self._half_m, self._ticks_per_m = drive.track_m / 2, drive.ticks_per_revolution / (math.tau * drive.wheel_radius_m)
        self._begun_s: float | None = None

    def ticks_at(self, time_s: float) -> tuple[int, int]:
        """See `Counter`."""
        self._begun_s = time_s if self._begun_s is None else self._begun_s
        seconds = time_s - self._begun_s
        left, right = (self.speed_mps + side * self._half_m * self.turn_rad_s for side in (-1, 1))
        return math.floor(left * seconds * self._ticks_per_m), math.floor(right * seconds * self._ticks_per_m)


def wall_errors_m(scan: LaserScan) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """How far each returned range is from the walls within a tenth of a degree of its bearing."""
    is_return = np.isfinite(scan.ranges_m)
    bearings = POSE.theta_rad + scan.angles_rad[is_return].astype(float)
    origins = np.tile([POSE.x_m, POSE.y_m], (len(bearings), 1))
    steps = np.radians((-0.1, -0.05, 0.0, 0.05, 0.1))
    near = [np.abs(cast_all(ROOM.segments, origins, bearings + step, 100.0) - scan.ranges_m[is_return]) for step in steps]
    return np.minimum.reduce(near)
