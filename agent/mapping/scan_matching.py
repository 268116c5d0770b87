"""Where a scan fits: Gauss-Newton on the likelihood field, for one pose or for all particles at once.

Maximises  sum_i L(T p_i)  -  1/2 (x - prior)' W (x - prior)   over the pose x = (x, y, theta); L is the field, a Gaussian
of the distance to the nearest wall, and W what odometry knows.  The curvature H of the sum says what the walls determine:
where its weakest eigenvalue is a small part of the strongest, the geometry leaves that direction open (a corridor) and the
prior decides.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent.mapping.likelihood import TiledFields

ITERATIONS = 4
MAX_STEP = np.array([0.15, 0.15, 0.1])  # metres, metres, radians: a wilder step has left the basin
PRIOR_GAIN = 0.3  # neighbouring beams repeat one another, but odometry errs in the same direction again and again
FLAT_SLOPE = np.float32(1.0)  # per metre: below it a slope is rounding, not the direction of a wall
LONE_WEIGHT = np.float32(0.25)  # of a point without a normal: far down a corridor they are dots that move along with the robot
ARM_M = 5.0  # a radian counts as this many metres when directions are compared
UNCONSTRAINED_RATIO = 0.02  # weakest to strongest curvature; a bare corridor with a few door frames has about 0.01

Poses = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """How (P,) poses fit, each in its particle's field."""

    poses: Poses  # (P, 3) x, y, theta
    likelihood: NDArray[np.float32]  # (P, M) field value under every point
    curvature: NDArray[np.float64]  # (P, 3, 3) of the walls alone

    def fractions(self) -> NDArray[np.float64]:
        """(P,) mean field value: 1 when every point lies on a mapped wall."""
        return np.asarray(self.likelihood.mean(axis=1, dtype=np.float64))


def refine(
    fields: TiledFields,
    particles: NDArray[np.int64],
    poses: Poses,
    priors: Poses,
    weights: NDArray[np.float64],
    surfels: NDArray[np.float32],
    iterations: int = ITERATIONS,
) -> Fit:
    """Gauss-Newton from (P, 3) poses, each held by its prior with information (P, 3, 3), in the fields of (P,) particles."""
    poses = poses.copy()
    for _ in range(iterations):  # no early end: on intel some particle still moves by 2 mm in 99 of 100 last steps
        _, pull, curvature = linearised(fields, particles, poses, surfels)
        pull = pull + np.einsum("pij,pj->pi", weights, difference(priors, poses))
        step = np.linalg.solve(curvature + weights, pull[:, :, None])[:, :, 0]
        poses += np.clip(step, -MAX_STEP, MAX_STEP)
    value, _, curvature = linearised(fields, particles, poses, surfels)
    return Fit(poses, value, curvature)


def linearised(
    fields: TiledFields, particles: NDArray[np.int64], poses: Poses, surfels: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.float64]]:
    """Field value (P, M) under every point, slope (P, 3) of their sum by the pose, and its curvature (P, 3, 3).

    Each point is pulled to its wall by a spring of stiffness L / sigma^2 along the normal that the scan itself shows: the
    field's ripple along a wall holds nothing back.  Points without one (corners, lone ones) follow the field's slope.
    Gauss-Newton on 1 - L would only halve the error in each step, for the field is flat on the wall; this one removes it.
    """
    value, slope, stiffness, moves = springs(fields, particles, poses, surfels)
    curvature = np.einsum("pim,pjm->pij", moves * stiffness[:, None], moves)
    return value, np.einsum("pim,pm->pi", moves, slope).astype(np.float64), curvature.astype(np.float64)


def springs(
    fields: TiledFields, particles: NDArray[np.int64], poses: Poses, surfels: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Under every point (P, M): field value, slope and stiffness; and (P, 3, M) how the pose moves it along its normal."""
    x, y, arm_x, arm_y = placed(poses, surfels)
    value, slope_x, slope_y = fields.look_up(particles, x, y)
    normal_x, normal_y = turned_normals(poses, surfels)
    lone = np.flatnonzero((surfels[:, 2] == 0) & (surfels[:, 3] == 0))
    if len(lone):
        length = np.sqrt(slope_x[:, lone] ** 2 + slope_y[:, lone] ** 2 + FLAT_SLOPE**2)
        normal_x[:, lone], normal_y[:, lone] = slope_x[:, lone] / length, slope_y[:, lone] / length
    slope, held = slope_x * normal_x + slope_y * normal_y, value.copy()
    moves = np.stack([normal_x, normal_y, normal_y * arm_x - normal_x * arm_y], axis=1)  # (P, 3, M)
    if len(lone):
        slope[:, lone] *= LONE_WEIGHT
        held[:, lone] *= LONE_WEIGHT
    return value, slope, held * np.float32(fields.sigma_m**-2), moves


def turned_normals(poses: Poses, surfels: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(P, M) x and y of the normals in the map frame."""
    cos = np.cos(poses[:, 2:]).astype(np.float32)
    sin = np.sin(poses[:, 2:]).astype(np.float32)
    return cos * surfels[:, 2] - sin * surfels[:, 3], sin * surfels[:, 2] + cos * surfels[:, 3]


def placed(poses: Poses, points_m: NDArray[np.float32]) -> tuple[NDArray[np.float32], ...]:
    """(P, M) map x and y of (M, 2) robot points under (P, 3) poses, and both relative to the robot."""
    cos = np.cos(poses[:, 2:]).astype(np.float32)
    sin = np.sin(poses[:, 2:]).astype(np.float32)
    arm_x = cos * points_m[:, 0] - sin * points_m[:, 1]
    arm_y = sin * points_m[:, 0] + cos * points_m[:, 1]
    return arm_x + poses[:, :1].astype(np.float32), arm_y + poses[:, 1:2].astype(np.float32), arm_x, arm_y


def difference(a: Poses, b: Poses) -> Poses:
    """a - b, angles wrapped."""
    d = a - b
    d[..., 2] = (d[..., 2] + np.pi) % (2.0 * np.pi) - np.pi
    return d


def information(deviation_m: float, deviation_rad: float) -> NDArray[np.float64]:
    """(3, 3) inverse covariance of a round prior."""
    return PRIOR_GAIN * np.diag([deviation_m**-2, deviation_m**-2, deviation_rad**-2])


def weakest_direction(curvature: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
    """Ratio of the weakest to the strongest curvature of a (3, 3), turns counted at ARM_M, and the weak direction."""
    scale = np.array([1.0, 1.0, 1.0 / ARM_M])
    values, vectors = np.linalg.eigh(curvature * np.outer(scale, scale))
    ratio = float(max(values[0], 0.0) / values[2]) if values[2] > 0 else 0.0
    return ratio, vectors[:, 0]
