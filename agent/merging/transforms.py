"""Many candidate transforms at once: arrays of (x, y, theta), grid frames, metres and radians."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from protocol.geometry import SE2

Poses = NDArray[np.float64]  # (C, 3) x, y, theta


def no_poses() -> Poses:
    return np.zeros((0, 3))


def to_se2(pose: NDArray[np.float64]) -> SE2:
    return SE2(float(pose[0]), float(pose[1]), math.remainder(float(pose[2]), math.tau))


def inverted(poses: Poses) -> Poses:
    """The inverse of every transform."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    x, y = poses[:, 0], poses[:, 1]
    return np.stack([-c * x - s * y, s * x - c * y, -poses[:, 2]], axis=1)


def applied(poses: Poses, point_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """(C, 2) where every transform takes one point, or its own point of (C, 2)."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    x, y = np.asarray(point_m, np.float64).reshape(-1, 2).T
    return np.stack([poses[:, 0] + c * x - s * y, poses[:, 1] + s * x + c * y], axis=1)


def taking(points_from: NDArray[np.float64], points_to: NDArray[np.float64], thetas: NDArray[np.float64]) -> Poses:
    """The transforms with these rotations that take each (N, 2) point to its partner."""
    c, s = np.cos(thetas), np.sin(thetas)
    x, y = points_from.T
    return np.stack([points_to[:, 0] - c * x + s * y, points_to[:, 1] - s * x - c * y, thetas], axis=1)


def angle_between(a_rad: NDArray[np.float64] | float, b_rad: NDArray[np.float64] | float) -> NDArray[np.float64]:
    """Unsigned, in [0, pi]."""
    difference: NDArray[np.float64] = np.abs(np.remainder(np.asarray(a_rad) - b_rad + math.pi, math.tau) - math.pi)
    return difference


def distinct(poses: Poses, scores: NDArray[np.floating], around_m: NDArray[np.float64], limit: int) -> NDArray[np.int64]:
    """Rows of the best poses, near-copies dropped: hashed into boxes of 1 m and 5 degrees on four shifted lattices.

    Two poses are near when they take `around_m`, the middle of their map, to near places.  A pose survives when it is
    the best of its box on every lattice; that costs a sort, where a greedy pass costs all pairs.
    """
    place = applied(poses, around_m)
    cells = np.column_stack([place, np.remainder(poses[:, 2], math.tau) * (1.0 / math.radians(5.0))])
    order = np.argsort(-scores, kind="stable")
    alive = np.ones(len(poses), np.bool_)
    for shift in ((0.0, 0.0, 0.0), (0.5, 0.5, 0.0), (0.5, 0.0, 0.5), (0.0, 0.5, 0.5)):
        ordered = np.floor(cells[order] + shift).astype(np.int64)
        key = (ordered[:, 0] << 42) ^ ((ordered[:, 1] & 0x1FFFFF) << 21) ^ (ordered[:, 2] % 72)
        first = np.zeros(len(poses), np.bool_)
        first[order[np.unique(key, return_index=True)[1]]] = True
        alive &= first
    kept = order[alive[order]]
    return kept[:limit]
