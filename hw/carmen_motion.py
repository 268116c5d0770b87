"""What the wheels say in a CARMEN log: which of its poses are raw odometry, and which are somebody's corrected ones.

    restarted   ODOM ... ODOM | FLASER at a corrected pose | ODOM repeats that pose, and goes on from there with raw motion ...
    in scans    the last three numbers of each scan line are odometry: alone in the log, or on the way that its ODOM lines tell
    ODOM lines  go on as if there were no scans, and scan lines have no pose, or a corrected one
    none        nothing but corrected poses, or no poses at all

A corrected pose is the answer to the question that a map is asked; it is never handed on as motion.
"""

from __future__ import annotations

import itertools
import math
import statistics
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from hw.carmen_lines import CarmenLog, LaserLine, OdomLine
from protocol.geometry import SE2

Lines = Sequence[OdomLine | LaserLine]
REPEATED = 1e-4  # metres and radians: the same pose, printed twice
MOVED_M = 0.02
MOST = 0.9  # of the scans; the first minutes of a corrected way lie on the raw one, too
NEIGHBOURS = 3  # ODOM lines before and after a scan: lasers and wheels are logged some late, some early
ON_THE_WAY_M, ON_THE_WAY = 0.01, 0.1  # and of a step: wheels go in arcs
SAME_PLACE_M, SAME_PLACE_RAD = 0.01, 0.01  # a LIDAR is screwed on


@dataclass(frozen=True, slots=True)
class Step:
    """How the robot came from one scan to the next."""

    motion: SE2 | None = None  # None: not known
    way: tuple[tuple[float, SE2], ...] = ()  # stamps as written, and the motion until then


@dataclass(frozen=True, slots=True)
class Wheels:
    """A step a scan, where they were found, and where the LIDAR sits when the poses tell."""

    steps: list[Step]
    source: str
    T_base_laser: SE2 | None = None
    is_known: bool = True


def wheels_of(log: CarmenLog, is_called_corrected: bool) -> Wheels:
    """The raw motion in a log; `is_called_corrected` by whoever named the file."""
    poses, places = _poses(log.scans), [scan.robot.inverse() @ scan.laser for scan in log.scans if scan.robot and scan.laser]
    usual = _usual(places)
    T_robot_laser = usual if usual is not None and not _is_near(usual, SE2.identity()) else _told_mount(log)
    for pose_of in (_laser_pose, _robot_pose):
        if log.has_odometry and _restarts(log.lines, pose_of):
            return Wheels(_since_restarts(log.lines, pose_of), "its ODOM lines, which begin again at every corrected pose")
    if log.has_odometry:
        if poses and _lie_on_the_way(log.lines):
            return Wheels(_between(log.scans, poses), "the odometry in its scan lines, as its ODOM lines have it", T_robot_laser)
        return Wheels(_between(log.scans, _at_scans(log)), "its ODOM lines", T_robot_laser)
    if not poses or not _moves(poses):
        return Wheels([Step() for _ in log.scans], "none, so it is followed by its scans alone", T_robot_laser, is_known=False)
    if usual is not None and (log.is_filtered or is_called_corrected):
        return Wheels(
            [Step() for _ in log.scans],
            "none, all its poses are corrected ones, so it is followed by its scans alone",
            is_known=False,
        )
    return Wheels(_between(log.scans, poses), "the odometry in its scan lines", T_robot_laser)


def _laser_pose(scan: LaserLine) -> SE2 | None:
    return scan.laser


def _robot_pose(scan: LaserLine) -> SE2 | None:
    return scan.robot


def _poses(scans: list[LaserLine]) -> list[SE2]:
    """Of the robot at every scan; nothing when a scan has none."""
    return [scan.robot for scan in scans if scan.robot is not None] if all(scan.robot for scan in scans) else []


def _moves(poses: list[SE2]) -> bool:
    return any(pose.distance_m(poses[0]) > MOVED_M or abs(pose.theta_rad - poses[0].theta_rad) > MOVED_M for pose in poses)


def _restarts(lines: Lines, pose_of: Callable[[LaserLine], SE2 | None]) -> bool:
    """Whether, wherever the robot has moved, the ODOM after a scan repeats the scan's pose, and that is no step of the wheels."""
    moved = restarted = 0
    last: SE2 | None = None  # ODOM since the scan before
    before: SE2 | None = None  # pose of the scan before
    for i, line in enumerate(lines):
        if isinstance(line, OdomLine):
            last = line.pose
            continue
        pose = pose_of(line)
        if pose is None:
            return False
        if last is not None and before is not None and last.distance_m(before) > MOVED_M:
            moved += 1
            after = [other.pose for other in lines[i + 1 : i + 8] if isinstance(other, OdomLine)]
            restarted += bool(after) and _same(after[0], pose) and not _goes_on(last, pose, after)
        before, last = pose, None
    return restarted > moved / 2


def _same(a: SE2, b: SE2) -> bool:
    return a.distance_m(b) < REPEATED and abs(math.remainder(a.theta_rad - b.theta_rad, math.tau)) < REPEATED


def _goes_on(last: SE2, pose: SE2, after: list[SE2]) -> bool:
    """Whether the way to `pose` is one more step of wheels: none, or ahead and not longer than the next; others go anywhere."""
    step = last.inverse() @ pose
    step_m = math.hypot(step.x_m, step.y_m)
    following = next((pose.inverse() @ other for other in after if other.distance_m(pose) > 0.001), None)
    if step_m < REPEATED or following is None:
        return step_m < REPEATED
    is_ahead = step.x_m * following.x_m > 0 and abs(step.y_m) < 0.3 * abs(step.x_m)
    return is_ahead and step_m < 2 * math.hypot(following.x_m, following.y_m)


def _since_restarts(lines: Lines, pose_of: Callable[[LaserLine], SE2 | None]) -> list[Step]:
    """The raw motion to a scan is the last ODOM before it, seen from the corrected pose of the scan before."""
    steps: list[Step] = []
    odometry: list[OdomLine] = []  # since the last scan
    before: SE2 | None = None  # where the odometry restarted
    for line in lines:
        if isinstance(line, OdomLine):
            odometry.append(line)
            continue
        way = () if before is None else tuple((odom.stamp_s, before.inverse() @ odom.pose) for odom in odometry)
        steps.append(Step(SE2.identity() if before is None else way[-1][1] if way else None, way))
        before, odometry = pose_of(line), []
    return steps


def _lie_on_the_way(lines: Lines) -> bool:
    """Whether the robot's pose in almost every scan line is on the way that the ODOM lines around it tell."""
    asked = found = 0
    odometry = [line.pose for line in lines if isinstance(line, OdomLine)]
    seen = 0  # ODOM lines before this one
    for line in lines:
        if isinstance(line, OdomLine):
            seen += 1
            continue
        around = odometry[max(seen - NEIGHBOURS, 0) : seen + NEIGHBOURS]
        if line.robot is None or len(around) < 2:
            continue
        asked += 1
        found += any(_is_between(line.robot, a, b) for a, b in itertools.pairwise(around))
    return found >= MOST * asked > 0


def _is_between(pose: SE2, a: SE2, b: SE2) -> bool:
    """Whether a pose is on the straight line from one to the next, but for what an arc is off it."""
    length_m = a.distance_m(b)
    share = ((pose.x_m - a.x_m) * (b.x_m - a.x_m) + (pose.y_m - a.y_m) * (b.y_m - a.y_m)) / max(length_m, REPEATED) ** 2
    share = min(max(share, 0.0), 1.0)
    nearest = SE2(a.x_m + share * (b.x_m - a.x_m), a.y_m + share * (b.y_m - a.y_m), 0.0)
    return pose.distance_m(nearest) <= ON_THE_WAY_M + ON_THE_WAY * length_m


def _at_scans(log: CarmenLog) -> list[SE2]:
    """The odometry at every scan: between two ODOM lines by their stamps, or, when those are none, the one written before it."""
    odometry = [line for line in log.lines if isinstance(line, OdomLine)]
    stamps_s = np.array([line.stamp_s for line in odometry])
    scan_stamps_s = np.array([scan.stamp_s for scan in log.scans])
    inside = (scan_stamps_s >= stamps_s[0]) & (scan_stamps_s <= stamps_s[-1])
    if bool(np.all(np.diff(stamps_s) >= 0)) and stamps_s[-1] > stamps_s[0] and float(inside.mean()) >= MOST:
        table = np.array([[line.pose.x_m, line.pose.y_m, line.pose.theta_rad] for line in odometry])
        table[:, 2] = np.unwrap(table[:, 2])
        columns = [np.interp(scan_stamps_s, stamps_s, column) for column in table.T]
        return [SE2(float(x), float(y), float(theta)) for x, y, theta in zip(*columns, strict=True)]
    return list(_written_before(log.lines, odometry[0].pose))


def _written_before(lines: Lines, first: SE2) -> Iterator[SE2]:
    last = first
    for line in lines:
        if isinstance(line, OdomLine):
            last = line.pose
        else:
            yield last


def _between(scans: list[LaserLine], poses: list[SE2]) -> list[Step]:
    motions = [SE2.identity(), *(a.inverse() @ b for a, b in itertools.pairwise(poses))]
    return [Step(motion, ((scan.stamp_s, motion),)) for scan, motion in zip(scans, motions, strict=True)]


def _usual(places: list[SE2]) -> SE2 | None:
    """Where the LIDAR sits on the robot, when it always sits there; None when one of the two poses was corrected."""
    if not places:
        return None
    usual = SE2(*(statistics.median(getattr(place, name) for place in places) for name in ("x_m", "y_m", "theta_rad")))
    return usual if sum(_is_near(place, usual) for place in places) >= MOST * len(places) else None


def _told_mount(log: CarmenLog) -> SE2:
    return SE2(log.number("robot_frontlaser_offset", 0.0), log.number("robot_frontlaser_side_offset", 0.0), 0.0)


def _is_near(a: SE2, b: SE2) -> bool:
    return a.distance_m(b) < SAME_PLACE_M and abs(math.remainder(a.theta_rad - b.theta_rad, math.tau)) < SAME_PLACE_RAD
