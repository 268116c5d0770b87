"""CARMEN logs: real recordings as scans with the raw odometry a robot would have had.

    FLASER n r_1 ... r_n  x y theta  odom_x odom_y odom_theta  stamp host logger_stamp
    ODOM x y theta tv rv accel  stamp host logger_stamp

Ranges are in metres, counter-clockwise from the right. In the Radish recordings `x y theta` of a FLASER is a pose *corrected*
by somebody's filter, and the wheel odometry restarts at every corrected pose. The raw motion from one scan to the next is
therefore the last ODOM before the second scan relative to the FLASER pose of the first; chaining these motions gives raw
odometry, and the corrected pose is never handed on except as `T_map_laser`, the reference that benchmarks compare with.

Some of these logs bear no time: every stamp is zero.  Those get the stamps of a robot that drives at an ordinary speed, for a
metre within no time is no motion that anybody would believe.
"""

from __future__ import annotations

import gzip
import math
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import accumulate
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hw.errors import DeviceConfigError
from hw.readings import LaserScan
from protocol.geometry import SE2

MAX_LINE_CHARS = 20_000
MAX_BEAMS = 2_000
MAX_TEXT_BYTES = 1 << 30
CRUISE_M_S, CRUISE_RAD_S = 0.5, 0.8  # of a robot whose logger had no clock
FASTEST = 6.0  # times as fast as that on the average: the clock is none
NO_RETURN_M = 79.9  # SICK and most others write 80 m and more for "nothing came back"; shorter scanners say their own below


@dataclass(frozen=True, slots=True, eq=False)
class RecordedScan:
    """One FLASER line and how the robot had moved."""

    stamp_s: float  # seconds since the first scan
    written_s: float  # as the log says
    ranges_m: NDArray[np.float32]  # (N,) counter-clockwise from -90 deg; `inf` where nothing came back
    angles_rad: NDArray[np.float32]  # (N,)
    motion: SE2 | None  # raw wheel motion since the scan before; None: not recorded
    way: tuple[tuple[float, SE2], ...]  # every ODOM since the scan before: its stamp as written, and the raw motion until then
    T_map_laser: SE2  # the reference filter's pose: to compare with, never to map with

    def laser_scan(self, range_max_m: float = 80.0) -> LaserScan:
        """As the scanner would have reported it, all beams at one moment."""
        return LaserScan(self.stamp_s, self.ranges_m, self.angles_rad, 0.05, range_max_m)


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """The scans of one log, in order."""

    name: str
    scans: tuple[RecordedScan, ...]

    def part(self, index: int, count: int) -> Recording:
        """One of `count` equal stretches in time, `index` from 1; its first scan starts a frame of its own."""
        if not 1 <= index <= count:
            raise DeviceConfigError(f"{self.name}: part {index}/{count}; parts go from 1 to the number of parts")
        edges = [round(i * len(self.scans) / count) for i in range(count + 1)]
        scans = self.scans[edges[index - 1] : edges[index]]
        if not scans:
            raise DeviceConfigError(f"{self.name}: {len(self.scans)} scans cannot be cut into {count} parts")
        return Recording(f"{self.name} part {index}/{count}", (replace(scans[0], motion=SE2.identity()), *scans[1:]))


def read_recording(path: str | Path) -> Recording:
    """Read a log, plain or gzip; DeviceConfigError when it is no CARMEN log."""
    file = Path(path)
    try:
        with (gzip.open if file.suffix == ".gz" else open)(file, "rt", encoding="ascii", errors="replace") as lines:
            scans = with_a_clock(tuple(recorded_scans(_bounded(lines, file))))
    except FileNotFoundError as error:
        raise DeviceConfigError(f"{file}: no such recording") from error
    except (OSError, EOFError, zlib.error) as error:
        raise DeviceConfigError(f"{file}: cannot be read: {error}") from error
    if not scans:
        raise DeviceConfigError(f"{file}: no FLASER line in it; is this a CARMEN log?")
    return Recording(file.name.removesuffix(".gz").removesuffix(".log").removesuffix(".clf"), scans)


def recorded_scans(lines: Iterable[str]) -> Iterator[RecordedScan]:
    """Scans from the lines of a log; lines that are no whole FLASER or ODOM are passed over."""
    odometry: list[tuple[float, SE2]] = []  # every ODOM since the last FLASER
    before: SE2 | None = None  # corrected pose of the last FLASER: where the odometry restarted
    first_stamp_s: float | None = None
    for line in lines:
        if line.startswith("ODOM "):
            values = _numbers(line.split()[1:8])
            if len(values) == 7:
                odometry.append((values[6], SE2(*values[:3])))
        elif line.startswith("FLASER "):
            parsed = _flaser(line.split())
            if parsed is None:
                continue
            stamp_s, ranges_m, pose = parsed
            first_stamp_s = stamp_s if first_stamp_s is None else first_stamp_s
            way = () if before is None else tuple((s, before.inverse() @ odom) for s, odom in odometry)
            motion = SE2.identity() if before is None else way[-1][1] if way else None
            angles_rad = beam_angles_rad(len(ranges_m))
            yield RecordedScan(stamp_s - first_stamp_s, stamp_s, ranges_m, angles_rad, motion, way, pose)
            before, odometry = pose, []


def with_a_clock(scans: tuple[RecordedScan, ...]) -> tuple[RecordedScan, ...]:
    """The scans as they are, or, where the clock of the log cannot be true, with the time that their ways take."""
    motions = [scan.motion or SE2.identity() for scan in scans]
    seconds = [math.hypot(m.x_m, m.y_m) / CRUISE_M_S + abs(m.theta_rad) / CRUISE_RAD_S for m in motions]
    if not scans or scans[-1].stamp_s * FASTEST >= sum(seconds):
        return scans
    return tuple(replace(scan, stamp_s=stamp_s) for scan, stamp_s in zip(scans, accumulate(seconds), strict=True))


def _flaser(words: list[str]) -> tuple[float, NDArray[np.float32], SE2] | None:
    if len(words) < 2 or not words[1].isdigit():
        return None
    n = int(words[1])
    values = _numbers(words[2 : n + 9])
    if not 1 < n <= MAX_BEAMS or len(values) != n + 7:
        return None
    ranges_m = np.array(values[:n], np.float32)
    ranges_m[(ranges_m >= NO_RETURN_M) | (ranges_m <= 0)] = np.inf
    return values[n + 6], ranges_m, SE2(*values[n : n + 3])


def beam_angles_rad(n: int) -> NDArray[np.float32]:
    """(n,) bearings: 1 degree apart for 180 or 181 beams, half a degree for 360 or 361, else 180 degrees shared evenly."""
    step_rad = math.pi / (n if n % 2 == 0 else n - 1)
    return (-math.pi / 2 + step_rad * np.arange(n)).astype(np.float32)


def _numbers(words: list[str]) -> list[float]:
    """All of them, or none when one is no finite number."""
    try:
        values = [float(word) for word in words]
    except ValueError:
        return []
    return values if all(map(math.isfinite, values)) else []


def _bounded(lines: Iterable[str], file: Path) -> Iterator[str]:
    size = 0
    for line in lines:
        size += len(line)
        if len(line) > MAX_LINE_CHARS or size > MAX_TEXT_BYTES:
            raise DeviceConfigError(f"{file}: a line of {len(line)} characters, {size} in all; this is no CARMEN log")
        yield line
