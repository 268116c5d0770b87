"""The lines of a CARMEN log, in each of the dialects that its loggers, and the filters that read them, have written.

    FLASER n r_1 ... r_n  x y theta  odom_x odom_y odom_theta  stamp host logger_stamp              front laser of 180 degrees
    ROBOTLASER1 type start fov step max_range accuracy [remission_mode]  n r_1 ... r_n  [m remission_1 ... remission_m]
                laser_x laser_y laser_theta  robot_x robot_y robot_theta  tv rv forward side [turn]  stamp host logger_stamp
    RAWLASER1   the same, without the poses and what follows them
    LASER_READING n r_1 ... r_n  x y theta  stamp                                            GMapping's own log: raw odometry
    ODOM x y theta tv rv accel  stamp host logger_stamp
    PARAM name value ...

Rear lasers, SYNC, TRUEPOS, NMEA, comments and lines that are not whole are passed over.  Metres and radians; beams run
counter-clockwise.  Of a log that holds one laser in several kinds of line, the kind that says most is read.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import product

import numpy as np
from numpy.typing import NDArray

from protocol.geometry import SE2

MAX_BEAMS = 10_000
NO_RETURN_M = 79.9  # SICK and most others write 80 m and more for "nothing came back"; shorter scanners say their own below
FARTHEST_M = 80.0
KINDS = ("ROBOTLASER1", "FLASER", "RAWLASER1", "LASER_READING")  # the one that says most first
FILTERED = ("NEFF", "ODO_UPDATE", "SM_UPDATE", "RESAMPLE", "ENTROPY")  # only a particle filter writes these
# Beams that do not look over half a turn: degrees apart.  SICK LMS1xx, TiM, S300; Hokuyo UTM and URG; LMS at 100 degrees.
STEP_DEG = {540: 0.5, 541: 0.5, 1080: 0.25, 1081: 0.25, 682: 360 / 1024, 683: 360 / 1024, 769: 360 / 1024, 400: 0.25, 401: 0.25}


@dataclass(frozen=True, slots=True)
class OdomLine:
    """Where the wheels say the robot is."""

    pose: SE2
    stamp_s: float


@dataclass(frozen=True, slots=True, eq=False)
class LaserLine:
    """One scan, and what its line says of poses: raw or corrected, the line alone does not tell."""

    ranges_m: NDArray[np.float32]  # (N,) `inf` where nothing came back
    angles_rad: NDArray[np.float32]  # (N,)
    max_range_m: float
    laser: SE2 | None
    robot: SE2 | None
    stamp_s: float
    logged_s: float  # by the logger's clock


@dataclass(slots=True)
class CarmenLog:
    """What a log holds, in the order it was written."""

    lines: list[OdomLine | LaserLine] = field(default_factory=list)
    params: dict[str, str] = field(default_factory=dict)
    is_filtered: bool = False  # a particle filter has been at it

    @property
    def scans(self) -> list[LaserLine]:
        return [line for line in self.lines if isinstance(line, LaserLine)]

    @property
    def has_odometry(self) -> bool:
        return any(isinstance(line, OdomLine) for line in self.lines)

    def number(self, name: str, default: float) -> float:
        """A parameter that is a number."""
        values = _numbers([self.params.get(name, "")])
        return values[0] if values else default


def read_log(lines: Iterable[str]) -> CarmenLog:
    """Everything that can be understood; nothing at all is no error here."""
    log, kinds = CarmenLog(), dict[str, list[tuple[int, OdomLine | LaserLine]]]()
    odometry: list[tuple[int, OdomLine | LaserLine]] = []
    for number, line in enumerate(lines):
        kind = line[: line.find(" ")] if " " in line[:20] else line[:20].strip()
        if kind == "ODOM":
            values = _numbers(line.split()[1:8])
            if len(values) == 7:
                odometry.append((number, OdomLine(SE2(*values[:3]), values[6])))
        elif kind in KINDS:
            scan = _laser(kind, line.split(), log)
            if scan is not None:
                kinds.setdefault(kind, []).append((number, scan))
        elif kind == "PARAM":
            name, value = [*line.split()[1:3], "", ""][:2]
            log.params[name] = value
        elif kind in FILTERED:
            log.is_filtered = True
    best = next((kind for kind in KINDS if kind in kinds), None)
    if best is not None:
        log.lines = [line for _, line in sorted([*odometry, *kinds[best]], key=lambda numbered: numbered[0])]
        log.is_filtered &= best != "LASER_READING"  # the filter's own log tells what went into it
    return log


def beam_angles_rad(n: int, step_deg: float = 0.0) -> NDArray[np.float32]:
    """(n,) bearings, the middle one ahead: as far apart as scanners of this many beams have them, else as told, else 180
    degrees shared evenly, beginning at the right."""
    if n not in (180, 181, 360, 361) and STEP_DEG.get(n, step_deg) > 0:
        return (math.radians(STEP_DEG.get(n, step_deg)) * (np.arange(n) - n // 2)).astype(np.float32)
    step_rad = math.pi / (n if n % 2 == 0 else n - 1)
    return (-math.pi / 2 + step_rad * np.arange(n)).astype(np.float32)


def _laser(kind: str, words: list[str], log: CarmenLog) -> LaserLine | None:
    if kind == "FLASER":
        return _flaser(words, log)
    return _reading(words) if kind == "LASER_READING" else _configured(words, has_poses=kind == "ROBOTLASER1")


def _flaser(words: list[str], log: CarmenLog) -> LaserLine | None:
    n = _count(words, 1)
    values = _numbers(words[2 : n + 9])
    if not n or len(values) != n + 7:
        return None
    max_range_m = log.number("robot_front_laser_max", FARTHEST_M)
    angles_rad = beam_angles_rad(n, log.number("laser_front_laser_resolution", 0.0))
    logged = _numbers(words[n + 10 : n + 11])
    poses = SE2(*values[n : n + 3]), SE2(*values[n + 3 : n + 6])
    return _scan(values[:n], angles_rad, max_range_m, *poses, values[n + 6], logged)


def _reading(words: list[str]) -> LaserLine | None:
    n = _count(words, 1)
    values = _numbers(words[2 : n + 6])
    if not n or len(values) != n + 4:
        return None
    pose = SE2(*values[n : n + 3])
    return _scan(values[:n], beam_angles_rad(n), FARTHEST_M, pose, pose, values[n + 3], [])


def _configured(words: list[str], *, has_poses: bool) -> LaserLine | None:
    """ROBOTLASER1 and RAWLASER1, whose optional fields are known by the length of the line alone."""
    start_rad, fov_rad, step_rad, max_range_m = [*_numbers(words[2:6]), 0.0, 0.0, 0.0, 0.0][:4]
    for has_mode, has_remissions, velocities in product((1, 0), (1, 0), (5, 4) if has_poses else (0,)):
        at = 7 + has_mode
        n = _count(words, at)
        m = n if words[at + n + 1 : at + n + 2] == [str(n)] else 0
        end = at + 1 + n + (1 + m if has_remissions else 0)  # of the remissions
        if has_remissions and words[at + n + 1 : at + n + 2] != [str(m)]:
            continue
        if not n or len(words) != end + (6 if has_poses else 0) + velocities + 3:
            continue
        ranges_m, poses = _numbers(words[at + 1 : at + 1 + n]), _numbers(words[end : end + 6 if has_poses else end])
        stamps = _numbers([words[-3]])
        if len(ranges_m) != n or not stamps or (has_poses and len(poses) != 6):
            continue
        angles_rad = _angles_rad(n, start_rad, fov_rad, step_rad)
        laser, robot = (SE2(*poses[:3]), SE2(*poses[3:])) if has_poses else (None, None)
        return _scan(ranges_m, angles_rad, max_range_m, laser, robot, stamps[0], _numbers(words[-1:]))
    return None


def _angles_rad(n: int, start_rad: float, fov_rad: float, step_rad: float) -> NDArray[np.float32]:
    """(n,) as the line says; where its two sizes contradict each other the whole counts, and where it has none our own guess."""
    if fov_rad > 0 and not 0.9 * fov_rad <= step_rad * n <= 1.1 * fov_rad:
        step_rad = fov_rad / (n - 1)
    return (start_rad + step_rad * np.arange(n)).astype(np.float32) if step_rad > 0 else beam_angles_rad(n)


def _scan(
    ranges: list[float],
    angles_rad: NDArray[np.float32],
    max_range_m: float,
    laser: SE2 | None,
    robot: SE2 | None,
    stamp_s: float,
    logged: list[float],
) -> LaserLine:
    ranges_m = np.array(ranges, np.float32)
    farthest_m = max_range_m if 0.5 < max_range_m < FARTHEST_M else FARTHEST_M
    ranges_m[(ranges_m >= min(NO_RETURN_M, 0.999 * farthest_m)) | (ranges_m <= 0)] = np.inf
    return LaserLine(ranges_m, angles_rad, farthest_m, laser, robot, stamp_s, logged[0] if logged else stamp_s)


def _count(words: list[str], at: int) -> int:
    """A number of beams that can be, else 0."""
    word = words[at] if at < len(words) else ""
    return int(word) if word.isdecimal() and len(word) < 6 and 1 < int(word) <= MAX_BEAMS else 0


def _numbers(words: list[str]) -> list[float]:
    """All of them, or none when one is no finite number."""
    try:
        values = [float(word) for word in words]
    except ValueError:
        return []
    return values if all(map(math.isfinite, values)) else []
