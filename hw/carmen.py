"""CARMEN logs: recordings of other people's robots as scans, with the raw odometry that these robots had.

What the lines say is understood in carmen_lines.py; which of the poses in them are wheels, and which are somebody's corrected
ones, in carmen_motion.py; whether their stamps can be true in carmen_clock.py.  A corrected pose is never handed on but as
`T_map_laser`, the reference that benchmarks compare with.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hw.carmen_clock import seconds_of
from hw.carmen_lines import CarmenLog, read_log
from hw.carmen_motion import wheels_of
from hw.errors import DeviceConfigError
from hw.log_files import text_lines
from hw.readings import LaserScan
from protocol.geometry import SE2

CORRECTED = ("gfs", "corrected")  # in a file's name: what a filter made of a log


@dataclass(frozen=True, slots=True, eq=False)
class RecordedScan:
    """One scan and how the robot had moved."""

    stamp_s: float  # seconds since the first scan
    written_s: float  # as the log says
    ranges_m: NDArray[np.float32]  # (N,) counter-clockwise; `inf` where nothing came back
    angles_rad: NDArray[np.float32]  # (N,)
    motion: SE2 | None  # raw wheel motion since the scan before; None: not recorded
    way: tuple[tuple[float, SE2], ...]  # the odometry since the scan before: its stamps as written, and the raw motion until then
    T_map_laser: SE2  # as the log says, perhaps a filter's pose: to compare with, never to map with
    max_range_m: float = 80.0

    def laser_scan(self) -> LaserScan:
        """As the scanner would have reported it, all beams at one moment."""
        return LaserScan(self.stamp_s, self.ranges_m, self.angles_rad, 0.05, self.max_range_m)


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """The scans of one log, in order."""

    name: str
    scans: tuple[RecordedScan, ...]
    odometry: str = ""  # where in the log it was found
    has_odometry: bool = True
    T_base_laser: SE2 | None = None  # where the LIDAR sat, when the log says

    def laser_motion(self, scan: RecordedScan) -> SE2:
        """How the LIDAR, not the robot, moved to a scan: that of a robot whose LIDAR sits in its middle."""
        motion = scan.motion or SE2.identity()
        return motion if self.T_base_laser is None else self.T_base_laser.inverse() @ motion @ self.T_base_laser

    def part(self, index: int, count: int) -> Recording:
        """One of `count` equal stretches in time, `index` from 1; its first scan starts a frame of its own."""
        if not 1 <= index <= count:
            raise DeviceConfigError(f"{self.name}: part {index}/{count}; parts go from 1 to the number of parts")
        edges = [round(i * len(self.scans) / count) for i in range(count + 1)]
        scans = self.scans[edges[index - 1] : edges[index]]
        if not scans:
            raise DeviceConfigError(f"{self.name}: {len(self.scans)} scans cannot be cut into {count} parts")
        first = replace(scans[0], motion=SE2.identity())
        return replace(self, name=f"{self.name} part {index}/{count}", scans=(first, *scans[1:]))


def read_recording(path: str | Path) -> Recording:
    """Read a log, plain or packed; DeviceConfigError when it is no CARMEN log."""
    file = Path(path)
    log = read_log(text_lines(file))
    if not log.scans:
        raise DeviceConfigError(f"{file}: no FLASER, ROBOTLASER1 or RAWLASER1 line in it; is this a CARMEN log?")
    return recording_of(log, file.name)


def recording_of(log: CarmenLog, file_name: str) -> Recording:
    """The scans of a log that has some, with the motion of the wheels between them."""
    wheels = wheels_of(log, any(word in file_name.lower() for word in CORRECTED))
    clocks = [[scan.stamp_s for scan in log.scans], [scan.logged_s for scan in log.scans]]
    seconds = seconds_of(clocks, [step.motion for step in wheels.steps])
    scans = tuple(
        RecordedScan(
            at_s,
            scan.stamp_s,
            scan.ranges_m,
            scan.angles_rad,
            step.motion,
            step.way,
            scan.laser or SE2.identity(),
            scan.max_range_m,
        )
        for scan, step, at_s in zip(log.scans, wheels.steps, seconds, strict=True)
    )
    return Recording(_stem(file_name), scans, wheels.source, wheels.is_known, wheels.T_base_laser)


def _stem(name: str) -> str:
    for suffix in (".gz", ".bz2", ".xz", ".log", ".clf"):
        name = name.removesuffix(suffix)
    return name
