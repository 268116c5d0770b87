"""A tiny world of segments for mapping tests: ray casting in ten lines, a robot on rails, odometry that drifts."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hw.readings import LaserScan, Odometry
from protocol.geometry import SE2

# Two rooms joined by a door, a box and a bench: corners everywhere, no symmetry.  (S, 4) x1 y1 x2 y2 metres.
ROOMS = np.array(
    [
        [-4, -3, 8, -3], [8, -3, 8, 4], [8, 4, -4, 4], [-4, 4, -4, -3],
        [3, -3, 3, -0.5], [3, 0.7, 3, 4],
        [-2.5, 1.5, -1.2, 1.5], [-1.2, 1.5, -1.2, 2.6], [-1.2, 2.6, -2.5, 2.6], [-2.5, 2.6, -2.5, 1.5],
        [5.5, -3, 5.5, -1.8], [5.5, -1.8, 6.6, -1.8], [6.6, -1.8, 6.6, -3],
        [4.2, 3.2, 5.0, 2.4],
    ]
)  # fmt: skip
CORRIDOR = np.array([[-40.0, -1.0, 40.0, -1.0], [-40.0, 1.0, 40.0, 1.0]])


def cast(world: NDArray[np.float64], pose: SE2, angles_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N,) distance to the nearest segment along each beam, inf when there is none."""
    direction = np.stack([np.cos(pose.theta_rad + angles_rad), np.sin(pose.theta_rad + angles_rad)], axis=1)[:, None]
    a, b = world[None, :, :2] - (pose.x_m, pose.y_m), world[None, :, 2:] - (pose.x_m, pose.y_m)
    along = b - a
    cross = direction[..., 0] * along[..., 1] - direction[..., 1] * along[..., 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (a[..., 0] * along[..., 1] - a[..., 1] * along[..., 0]) / cross
        where = (a[..., 0] * direction[..., 1] - a[..., 1] * direction[..., 0]) / cross
    return np.asarray(np.where((distance > 0) & (where >= 0) & (where <= 1), distance, np.inf).min(axis=1))


def scan_at(
    world: NDArray[np.float64],
    pose: SE2,
    stamp_s: float,
    rng: np.random.Generator,
    beams: int = 180,
    noise_m: float = 0.01,
    max_m: float = 12.0,
) -> LaserScan:
    angles = np.arange(beams) * (math.tau / beams) - math.pi
    ranges = cast(world, pose, angles)
    ranges = ranges + rng.normal(0.0, noise_m, beams)
    ranges[ranges > max_m] = np.inf
    return LaserScan(stamp_s, ranges.astype(np.float32), angles.astype(np.float32), 0.05, max_m)


def rounds(seconds: float, hz: float = 5.0, speed_m_s: float = 0.5, turn_rad_s: float = 0.8) -> list[tuple[float, SE2]]:
    """Stamps and true poses of a robot that goes round and round through the door: drive to a corner, turn, drive on."""
    corners = np.array([[-3.0, -0.2], [6.8, -0.3], [7.0, 0.6], [-2.8, 0.5]])
    path, pose, goal = [], SE2(-3.0, -0.2, 0.0), 1
    for k in range(int(seconds * hz)):
        path.append((k / hz, pose))
        ahead = pose.inverse().apply(corners[goal : goal + 1])[0]
        bearing = math.atan2(ahead[1], ahead[0])
        if math.hypot(*ahead) < 0.15:
            goal = (goal + 1) % len(corners)
        turn = max(-turn_rad_s / hz, min(turn_rad_s / hz, bearing))
        pose = pose @ SE2(speed_m_s / hz if abs(bearing) < 0.3 else 0.0, 0.0, turn)
    return path


class DriftingOdometry:
    """Wheels that measure each step 3 % too long and turn by a little more than they should."""

    def __init__(self, rng: np.random.Generator, scale: float = 1.03, bias_rad_per_m: float = 0.02) -> None:
        self.rng, self.scale, self.bias = rng, scale, bias_rad_per_m
        self.last: SE2 | None = None
        self.pose = SE2.identity()

    def sample(self, stamp_s: float, true_pose: SE2) -> Odometry:
        if self.last is not None:
            step = self.last.inverse() @ true_pose
            distance = math.hypot(step.x_m, step.y_m)
            turn = step.theta_rad * self.rng.normal(1.0, 0.03) + distance * self.bias
            self.pose = self.pose @ SE2(step.x_m * self.scale, step.y_m * self.scale, turn)
        self.last = true_pose
        return Odometry(stamp_s, self.pose.x_m, self.pose.y_m, self.pose.theta_rad)
