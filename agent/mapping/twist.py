"""How a revolution is twisted: by how much the robot turned between its first beam and its last, beyond what its wheels told.

The motion within a revolution is undone by the wheels; when these slip, the scan is a spiral, and maps of spirals bend.  So
the twist is matched together with the pose, as a fourth unknown: point i of a surfel measured t_i revolutions from the
middle stands at  x + R(theta + t_i twist) p_i.

A map that was drawn of twisted scans shows every further one twisted alike: what matching says of the twist drifts away in
its mean, and is right about what changes from scan to scan.  The mean comes from the headings, which add up to the truth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent.mapping.likelihood import TiledFields
from agent.mapping.scan_matching import MAX_STEP, PRIOR_GAIN, difference, springs
from protocol.geometry import SE2

MOST_ITERATIONS = 5  # a twist of one degree needs them: after 3, a tenth of it was missing
ENOUGH_STEP = np.array([5e-4, 5e-4, 2e-4, 1e-3])  # metres, metres, radians, radians: the next would be smaller than noise
MOST_STEP = np.append(MAX_STEP, 0.1)
DEVIATION_RAD = 0.012  # one sigma within a revolution; at 0.004 wheels that slip by 6 % bend the map as if nobody looked
MEAN_OF = 40  # revolutions on the way; 12, 32 and 80 were no better on wheels that slip and wheels that do not
SPUN_RAD = math.radians(3.0)  # a wheel that spins tells nothing about the others
STANDING_M = 0.005  # within a revolution, turns counted at ARM_M: who stands still is not twisted
ARM_M = 0.3


@dataclass(slots=True)
class TwistMeans:
    """What remains of the last revolutions on the way."""

    matched_rad: float = 0.0  # by which a scan seemed twisted
    turned_rad: float = 0.0  # by which its heading differed from the wheels'

    def corrected(self, matched_rad: float, turned_rad: float) -> float:
        """The twist of one more revolution."""
        if abs(turned_rad) < SPUN_RAD:
            self.matched_rad += (matched_rad - self.matched_rad) / MEAN_OF
            self.turned_rad += (turned_rad - self.turned_rad) / MEAN_OF
        return matched_rad - self.matched_rad + self.turned_rad


def refine_twisted(
    fields: TiledFields,
    particle: int,
    pose: NDArray[np.float64],
    prior: NDArray[np.float64],
    weights: NDArray[np.float64],
    surfels: NDArray[np.float32],
    turns: NDArray[np.float32],
) -> tuple[NDArray[np.float64], float]:
    """The pose (3,) and the twist that fit best, from a pose near by; as `scan_matching.refine`, for one particle."""
    particles, held = np.array([particle]), np.zeros((4, 4))
    held[:3, :3], held[3, 3] = weights, PRIOR_GAIN * DEVIATION_RAD**-2
    state, priors = np.append(pose, 0.0), np.append(prior, 0.0)  # x, y, theta, twist
    for _ in range(MOST_ITERATIONS):
        seen = twisted(surfels, (state[3] * turns).astype(np.float32))
        _, slope, stiffness, moves = (values[0] for values in springs(fields, particles, state[None, :3], seen))
        moves = np.concatenate([moves, moves[2:] * turns])  # (4, M)
        pull = moves @ slope + held @ difference(priors, state)
        step = np.clip(np.linalg.solve((moves * stiffness) @ moves.T + held, pull), -MOST_STEP, MOST_STEP)
        state += step
        if np.all(np.abs(step) < ENOUGH_STEP):
            break
    return state[:3], float(state[3])


def twisted(surfels: NDArray[np.float32], angles_rad: NDArray[np.float32]) -> NDArray[np.float32]:
    """(M, 4) surfels, each turned about the robot by its own angle."""
    cos, sin = np.cos(angles_rad), np.sin(angles_rad)
    x, y, normal_x, normal_y = surfels.T
    turned_x, turned_y = cos * normal_x - sin * normal_y, sin * normal_x + cos * normal_y
    return np.stack([cos * x - sin * y, sin * x + cos * y, turned_x, turned_y], axis=1)


def way_m(motion: SE2) -> float:
    """How far the wheels went, turns counted at ARM_M."""
    return math.hypot(motion.x_m, motion.y_m) + ARM_M * abs(motion.theta_rad)
