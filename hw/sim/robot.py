"""A differential-drive robot that explores a world by itself: true poses, and what its wheel encoders count.

It knows the true world and always drives to the place farthest from where it has been that is not too far away, so a fleet
covers a building with overlap.  Motion is integrated in fixed steps and kept, so that a LIDAR can ask for the pose at the
very moment of each beam.  Same world, start and seed: same drive, however often or seldom it is asked.
"""

from __future__ import annotations

import math
import threading
from bisect import bisect_left
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hw.sim.places import Cell, Clearance, Ways
from hw.sim.world import World
from protocol.geometry import SE2, wrap_angle

STEP_S = 0.005
KEPT_S = 60.0  # devices ask about the last fraction of a second; the demo about the pose a map was made at
PLANNING_RADIUS_M = 0.3  # of the disc that must fit along the way: the robot and a hand's breadth
ARRIVED_M = 0.12
FARTHEST_GOAL_M = 16.0  # of way: beyond it, exploring next door first is quicker


@dataclass(frozen=True, slots=True)
class DriveOptions:
    """What the base can do and how badly its encoders measure it."""

    speed_mps: float = 0.5
    turn_rad_s: float = 1.2
    track_m: float = 0.30
    wheel_radius_m: float = 0.05
    ticks_per_revolution: float = 2048
    scale_error: float = 0.005  # one sigma, each wheel, the whole run
    slip: float = 0.02  # one sigma of a metre driven, as a fraction, of each wheel
    first_ticks: tuple[int, int] = (0, 0)


class SimulatedRobot:
    """One robot in one world.  Thread-safe: its LIDAR and its wheel board may be served by different threads."""

    def __init__(self, world: World, start: SE2, seed: int = 0, options: DriveOptions | None = None) -> None:
        self.world, self.start, self.options = world, start, options or DriveOptions()
        rng = np.random.default_rng([21, seed])
        self._scale = 1.0 + self.options.scale_error * rng.standard_normal(2)
        self._slip_rng = rng
        self._pose = start
        self._rolled_m = np.zeros(2)  # left, right, as the encoders see it
        self._times: list[float] = []
        self._history: list[tuple[float, float, float, float, float]] = []  # x, y, theta (continuous), left, right
        self._theta = start.theta_rad
        self._explorer = Explorer(world, start, seed)
        self._path: list[tuple[float, float]] = []
        self._is_moving = False
        self._lock = threading.Lock()

    def begin(self) -> None:
        """Start to drive; before, the robot stands still and its devices already work."""
        with self._lock:
            self._is_moving = True

    def poses_at(self, times_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, 5) x, y, theta (continuous), rolled left, rolled right at N moments not older than a minute."""
        with self._lock:
            self._advance_to(float(times_s.max()))
            low = max(0, bisect_left(self._times, float(times_s.min())) - 1)
            times, rows = np.array(self._times[low:]), np.array(self._history[low:])
        return np.stack([np.interp(times_s, times, rows[:, k]) for k in range(5)], axis=1)

    def pose_at(self, time_s: float) -> SE2:
        """T_world_base."""
        x, y, theta = self.poses_at(np.array([time_s]))[0, :3]
        return SE2(float(x), float(y), wrap_angle(float(theta)))

    def ticks_at(self, time_s: float) -> tuple[int, int]:
        """Left and right encoder counters, not wrapped."""
        left_m, right_m = self.poses_at(np.array([time_s]))[0, 3:]
        per_metre = self.options.ticks_per_revolution / (math.tau * self.options.wheel_radius_m)
        first = self.options.first_ticks
        return first[0] + math.floor(left_m * per_metre), first[1] + math.floor(right_m * per_metre)

    def _advance_to(self, time_s: float) -> None:
        if not self._times:
            self._keep(time_s - STEP_S)
        while self._times[-1] < time_s:
            self._step()
            self._keep(self._times[-1] + STEP_S)
        if len(self._times) > 2 * KEPT_S / STEP_S:
            old = len(self._times) // 2
            del self._times[:old], self._history[:old]

    def _keep(self, time_s: float) -> None:
        self._times.append(time_s)
        left_m, right_m = self._rolled_m.tolist()
        self._history.append((self._pose.x_m, self._pose.y_m, self._theta, left_m, right_m))

    def _step(self) -> None:
        speed, turn = self._steer()
        if speed == 0.0 and turn == 0.0:
            return
        self._theta += turn * STEP_S
        self._pose = self._pose @ SE2(speed * STEP_S, 0.0, turn * STEP_S)
        half = turn * self.options.track_m / 2
        rolled = np.array([speed - half, speed + half]) * STEP_S
        # Slip per metre with variance growing with the way: its sigma over a step of length d is slip * sqrt(d).
        slip = self.options.slip * np.sqrt(np.abs(rolled)) * self._slip_rng.standard_normal(2)
        self._rolled_m += rolled * self._scale + slip * 0.3

    def _steer(self) -> tuple[float, float]:
        """(m/s, rad/s) towards the next corner of the path: turn on the spot when it is far off, else in a curve."""
        if not self._is_moving:
            return 0.0, 0.0
        while self._path and math.hypot(self._path[0][0] - self._pose.x_m, self._path[0][1] - self._pose.y_m) < ARRIVED_M:
            self._path.pop(0)
        if not self._path:
            self._path = self._explorer.next_leg()
            return 0.0, 0.0
        dx, dy = self._path[0][0] - self._pose.x_m, self._path[0][1] - self._pose.y_m
        error_rad = wrap_angle(math.atan2(dy, dx) - self._pose.theta_rad)
        limit = self.options.turn_rad_s
        turn = max(-limit, min(limit, 3.0 * error_rad))
        ahead = max(0.0, math.cos(error_rad)) ** 3 if abs(error_rad) < 0.8 else 0.0
        near = min(1.0, 0.3 + math.hypot(dx, dy))
        return self.options.speed_mps * ahead * near, turn


class Explorer:
    """Where to next.  Each leg is planned in the background while the one before is driven; a leg starts where the last ends."""

    def __init__(self, world: World, start: SE2, seed: int) -> None:
        self._ways = Ways(Clearance.of(world), PLANNING_RADIUS_M)
        self._rng = np.random.default_rng([22, seed])
        self._at = (start.x_m, start.y_m)
        self._visited = [self._at]
        self._leg: list[tuple[float, float]] = []
        self._planning: threading.Thread | None = None
        self._plan()

    def next_leg(self) -> list[tuple[float, float]]:
        """Corner points of the next stretch; waits when it is not planned yet."""
        if self._planning is not None:
            self._planning.join()
        leg = self._leg
        self._planning = threading.Thread(target=self._plan, name="explorer", daemon=True)
        self._planning.start()
        return list(leg)

    def _plan(self) -> None:
        lengths = self._ways.lengths_from(self._at, FARTHEST_GOAL_M)
        goal = self._goal(lengths)
        path = self._ways.path(lengths, goal, PLANNING_RADIUS_M - 0.05)
        self._leg = path[1:] or path
        self._at = self._leg[-1]
        self._visited += path

    def _goal(self, lengths: NDArray[np.float32]) -> Cell:
        """The reachable cell that is most new for its way: far from everything visited, a little random."""
        rows, cols = np.nonzero(np.isfinite(lengths) & (lengths < FARTHEST_GOAL_M) & (lengths > 0.5))
        if not len(rows):
            rows, cols = np.nonzero(np.isfinite(lengths))
        clearance = self._ways.clearance
        x = clearance.left_m + (cols + 0.5) * clearance.resolution_m
        y = clearance.bottom_m + (rows + 0.5) * clearance.resolution_m
        visited = np.array(self._visited)
        newness = np.full(len(rows), np.inf)
        for vx, vy in visited:
            np.minimum(newness, np.hypot(x - vx, y - vy), out=newness)
        value = np.minimum(newness, 6.0) - 0.2 * lengths[rows, cols] + self._rng.uniform(0, 0.5, len(rows))
        best = int(np.argmax(value))
        return int(rows[best]), int(cols[best])
