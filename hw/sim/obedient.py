"""A robot that stands where it was put until a client tells its wheels to turn: then it drives, through walls if it must.

Its devices sit on it as they do on the robot that explores by itself; only that here the commands of the base are obeyed.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass

import numpy as np

from hw.odometry import arc
from hw.sim.robot import DriveOptions
from hw.sim.sight import Floats
from hw.sim.world import World
from protocol.geometry import SE2

LEGS_KEPT = 64  # devices ask about the last fraction of a second


@dataclass(frozen=True, slots=True)
class _Leg:
    """Driven with constant speeds from a moment on."""

    begun_s: float
    T_world_base: SE2
    rolled_m: tuple[float, float]  # left, right
    speeds_mps: tuple[float, float]

    @property
    def is_standing(self) -> bool:
        return self.speeds_mps == (0.0, 0.0)


class ObedientRobot:
    """`PoseSource` of its LIDARs and `Counter` of its base."""

    def __init__(self, world: World, pose: SE2, drive: DriveOptions | None = None) -> None:
        self.world = world
        drive = drive or DriveOptions()
        self._track_m = drive.track_m
        self._ticks_per_m = drive.ticks_per_revolution / (math.tau * drive.wheel_radius_m)
        self._legs = [_Leg(-math.inf, pose, (0.0, 0.0), (0.0, 0.0))]

    def turn_wheels(self, left_ticks_per_s: float, right_ticks_per_s: float, now_s: float) -> None:
        """See `Drivable`."""
        speeds_mps = left_ticks_per_s / self._ticks_per_m, right_ticks_per_s / self._ticks_per_m
        if speeds_mps != self._legs[-1].speeds_mps:
            self._legs = [*self._legs[-LEGS_KEPT:], _Leg(now_s, *self._at(now_s), speeds_mps)]

    def poses_at(self, times_s: Floats) -> Floats:
        """See `PoseSource`."""
        if self._legs[-1].is_standing and times_s.min() >= self._legs[-1].begun_s:
            pose, rolled_m = self._at(float(times_s[-1]))
            return np.tile((pose.x_m, pose.y_m, pose.theta_rad, *rolled_m), (len(times_s), 1))
        seen = map(self._at, times_s.tolist())
        return np.array([(pose.x_m, pose.y_m, pose.theta_rad, *rolled_m) for pose, rolled_m in seen])

    def ticks_at(self, time_s: float) -> tuple[int, int]:
        """See `Counter`."""
        _, (left_m, right_m) = self._at(time_s)
        return math.floor(left_m * self._ticks_per_m), math.floor(right_m * self._ticks_per_m)

    def _at(self, time_s: float) -> tuple[SE2, tuple[float, float]]:
        leg = self._legs[max(0, bisect_right(self._legs, time_s, key=lambda leg: leg.begun_s) - 1)]
        if leg.is_standing:
            return leg.T_world_base, leg.rolled_m
        left_m, right_m = ((time_s - leg.begun_s) * speed for speed in leg.speeds_mps)
        return leg.T_world_base @ arc(left_m, right_m, self._track_m), (leg.rolled_m[0] + left_m, leg.rolled_m[1] + right_m)
