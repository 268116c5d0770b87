"""How the robot moved: odometry samples to the motion between two moments, and how far to trust it.

Wheels slip, boards reboot, cables fall out.  So `OdometryTrack` answers "from here to there" only where its samples are
continuous, and says so when they are not; the mapper then searches instead of believing.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hw.readings import Odometry
from protocol.geometry import SE2, wrap_angle

EXTRAPOLATION_S = 0.25  # a scan may be this much younger than the youngest odometry sample; boards report at 10 to 50 Hz
KEPT_SAMPLES = 2048  # 20 s at 100 Hz: longer than any gap between two scans that is still worth bridging
LONGEST_GAP_S = 10.0  # without a sample: the board may have started anew meanwhile
CLOCK_RESTART_S = 1.0  # a stamp this much older than the last is another clock; less is a late sample
SLOWEST_SPEED_LIMIT_S = 0.1  # two samples closer in time than this are judged as if this far apart: stamps jitter


@dataclass(frozen=True, slots=True)
class MotionNoise:
    """Standard deviations of measured motion, as fractions of it: an ordinary differential drive on office floor."""

    per_metre_m: float = 0.10  # of the distance driven; doubling it halves the pull of odometry in long corridors
    per_radian_m: float = 0.05
    floor_m: float = 0.02
    per_radian_rad: float = 0.10
    per_metre_rad: float = 0.03
    floor_rad: float = 0.01

    def deviations(self, motion: SE2) -> tuple[float, float]:
        """(metres, radians): one sigma of a motion."""
        distance_m, turn_rad = math.hypot(motion.x_m, motion.y_m), abs(motion.theta_rad)
        return (
            self.per_metre_m * distance_m + self.per_radian_m * turn_rad + self.floor_m,
            self.per_radian_rad * turn_rad + self.per_metre_rad * distance_m + self.floor_rad,
        )


@dataclass(frozen=True, slots=True)
class Motion:
    """Motion between two moments, in the robot frame of the first."""

    T_from_to: SE2
    is_known: bool  # False across a reset, a jump or a gap: T_from_to is then only what came before or after it


class OdometryTrack:
    """The last minutes of odometry, asked for poses at any moment between."""

    def __init__(self, max_speed_m_s: float, max_turn_rad_s: float) -> None:
        self.max_speed_m_s = max_speed_m_s
        self.max_turn_rad_s = max_turn_rad_s
        self.stamps_s: list[float] = []
        self.poses: list[tuple[float, float, float]] = []  # T_odom_base, theta continuous (not wrapped)
        self.pieces: list[int] = []  # samples with the same number belong to one unbroken run
        self.discontinuities = 0
        self.refused = 0

    def add(self, odometry: Odometry) -> bool:
        """Take one sample; False when it is older than the one before or not finite, and was refused."""
        sample = (odometry.x_m, odometry.y_m, odometry.theta_rad)
        if self.stamps_s and odometry.stamp_s < self.stamps_s[-1] - CLOCK_RESTART_S:
            self._begin_again()
        if not all(map(math.isfinite, (odometry.stamp_s, *sample))) or (self.stamps_s and odometry.stamp_s < self.stamps_s[-1]):
            self.refused += 1
            return False
        piece = self.pieces[-1] if self.pieces else 0
        if self.poses:
            last = self.poses[-1]
            sample = (sample[0], sample[1], last[2] + wrap_angle(sample[2] - last[2]))
            is_gap = odometry.stamp_s - self.stamps_s[-1] > LONGEST_GAP_S
            if odometry.is_discontinuity or is_gap or self._is_jump(odometry.stamp_s - self.stamps_s[-1], last, sample):
                piece += 1
                self.discontinuities += 1
        self.stamps_s.append(odometry.stamp_s)
        self.poses.append(sample)
        self.pieces.append(piece)
        if len(self.stamps_s) > 2 * KEPT_SAMPLES:
            del self.stamps_s[:-KEPT_SAMPLES], self.poses[:-KEPT_SAMPLES], self.pieces[:-KEPT_SAMPLES]
        return True

    def _begin_again(self) -> None:
        """The clock started again (a reboot between checkpoint and resume): what was before is no help any more."""
        self.stamps_s, self.poses, self.pieces = [], [], []
        self.discontinuities += 1

    def _is_jump(self, seconds: float, a: tuple[float, float, float], b: tuple[float, float, float]) -> bool:
        """Faster than the robot can be, with half again for jitter: a reset or a jump, never motion."""
        bound_s = 1.5 * max(seconds, SLOWEST_SPEED_LIMIT_S)
        moved_m = math.hypot(b[0] - a[0], b[1] - a[1])
        return moved_m > self.max_speed_m_s * bound_s or abs(b[2] - a[2]) > self.max_turn_rad_s * bound_s

    def pose_at(self, stamp_s: float) -> SE2 | None:
        """T_odom_base at a moment; None before the first sample or long after the last."""
        if not self.stamps_s or stamp_s < self.stamps_s[0] - EXTRAPOLATION_S or stamp_s > self.stamps_s[-1] + EXTRAPOLATION_S:
            return None
        x, y, theta = self.poses_at(np.array([stamp_s]))[0]
        return SE2(float(x), float(y), wrap_angle(float(theta)))

    def poses_at(self, stamps_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, 3) T_odom_base at N moments, straight lines between samples, constant speed beyond the last one."""
        low = max(0, bisect_right(self.stamps_s, float(stamps_s.min())) - 2)
        high = min(len(self.stamps_s), bisect_right(self.stamps_s, float(stamps_s.max())) + 1)
        times, poses = np.array(self.stamps_s[low:high]), np.array(self.poses[low:high])
        if high == len(self.stamps_s):
            times, poses = self._extended(times, poses)
        return np.stack([np.interp(stamps_s, times, poses[:, k]) for k in range(3)], axis=1)

    def _extended(
        self, times: NDArray[np.float64], poses: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """One more sample, EXTRAPOLATION_S later, at the speed of the last two."""
        seconds = times[-1] - times[-2] if len(times) > 1 else 0.0
        is_steady = seconds > 1e-3 and seconds <= EXTRAPOLATION_S and self.pieces[-1] == self.pieces[-2]
        speed = (poses[-1] - poses[-2]) / seconds if is_steady else np.zeros(3)
        return np.append(times, times[-1] + EXTRAPOLATION_S), np.vstack([poses, poses[-1] + EXTRAPOLATION_S * speed])

    def motion_between(self, from_s: float, to_s: float) -> Motion:
        """Motion from one moment to a later one; known only when the samples between are one unbroken run."""
        start, end = self.pose_at(from_s), self.pose_at(to_s)
        if start is None or end is None:
            return Motion(SE2.identity(), is_known=False)
        first = max(0, bisect_right(self.stamps_s, from_s) - 1)
        last = min(len(self.stamps_s) - 1, bisect_right(self.stamps_s, to_s))
        if self.pieces[first] == self.pieces[last]:
            return Motion(start.inverse() @ end, is_known=True)
        return Motion(self._motion_around_breaks(first, last), is_known=False)

    def _motion_around_breaks(self, first: int, last: int) -> SE2:
        """What the unbroken stretches say, the breaks themselves taken as standing still."""
        total = SE2.identity()
        for i in range(first, last):
            if self.pieces[i] == self.pieces[i + 1]:
                total = total @ (SE2(*self.poses[i]).inverse() @ SE2(*self.poses[i + 1]))
        return total


def undo_motion(points_m: NDArray[np.float64], poses: NDArray[np.float64], reference: SE2) -> NDArray[np.float64]:
    """(N, 2) points, each seen in the robot frame of its own pose (N, 3), as seen from the reference pose (same frame)."""
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    world = np.stack(
        [
            poses[:, 0] + cos * points_m[:, 0] - sin * points_m[:, 1],
            poses[:, 1] + sin * points_m[:, 0] + cos * points_m[:, 1],
        ],
        axis=1,
    )
    return reference.inverse().apply(world)
