"""What is neither straight nor round: pieces of curve, at three sizes, each told by its centre of mass and regression line.

Cutting a curve where the map happens to end would make every robot see other curves.  So a piece is all the wall within a given
radius of where that wall is densest (mean shift), at each of three radii: two robots that both saw that neighbourhood get the
same piece, wherever the rest of their curves end.  Pieces of one size never share a point.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from protocol.features import CURVE_COLUMNS

RADII_M = (0.6, 1.2, 2.4)
MIN_FILL = 1.0  # wall in a piece, in radii: less is a splinter
MAX_POINTS = 2000
MAX_STARTS = 250
MAX_PER_RADIUS = 16
_BLOCK = 25  # centres at a time, so that what they need stays in cache
_SHIFTS = 3  # mean-shift steps; most settle in two


def curve_table(points_m: NDArray[np.float64], normals: NDArray[np.float64], spacing_m: float) -> NDArray[np.float32]:
    """(N, 5) `CURVE_COLUMNS` of (N, 2) wall points, each standing for `spacing_m`, whose normals point to the free side."""
    if not len(points_m):
        return np.zeros((0, len(CURVE_COLUMNS)), np.float32)
    stride = -(-len(points_m) // MAX_POINTS)
    points_m, normals, spacing_m = points_m[::stride], normals[::stride], spacing_m * stride
    rows = [row for radius_m in RADII_M for row in _pieces(points_m, normals, radius_m, spacing_m)]
    return np.array(rows, np.float32).reshape(-1, len(CURVE_COLUMNS))


def _pieces(points: NDArray[np.float64], normals: NDArray[np.float64], radius_m: float, spacing_m: float) -> list[list[float]]:
    """Disjoint pieces of one radius, the fullest first."""
    centres = _settled(points, radius_m)
    members = _within(points, centres, radius_m)
    order = np.lexsort((centres[:, 1], centres[:, 0], -members.sum(axis=1)))
    free = np.ones(len(points), np.bool_)
    rows: list[list[float]] = []
    for i in order.tolist():
        if len(rows) == MAX_PER_RADIUS:
            break
        mine = members[i]
        if mine.sum() * spacing_m < MIN_FILL * radius_m or not free[mine].all():
            continue
        free[mine] = False
        rows.append(_described(points[mine], normals[mine], spacing_m))
    return rows


def _settled(points: NDArray[np.float64], radius_m: float) -> NDArray[np.float64]:
    """(K, 2) places where mean shift ends, started from one point in every square of half the radius."""
    square = np.floor(points / (0.5 * radius_m)).astype(np.int64)
    _, first = np.unique((square[:, 0] << 32) + square[:, 1], return_index=True)
    first = first[:: -(-len(first) // MAX_STARTS)]
    middle = points.mean(axis=0)
    local = (points - middle).astype(np.float32)
    weighed = np.column_stack([local, np.ones(len(points), np.float32)])
    centres = local[first]
    for block in range(0, len(centres), _BLOCK):
        mine = np.s_[block : block + _BLOCK]
        for _ in range(_SHIFTS):
            sums = _within(local, centres[mine], radius_m).astype(np.float32) @ weighed
            centres[mine] = sums[:, :2] / np.maximum(sums[:, 2:], 1.0)
    settled: NDArray[np.float64] = centres + middle
    return settled


def _within(points: NDArray[np.floating], centres: NDArray[np.floating], radius_m: float) -> NDArray[np.bool_]:
    """(K, N) which points lie within the radius of which centres."""
    dx = points[None, :, 0] - centres[:, None, 0]
    dy = points[None, :, 1] - centres[:, None, 1]
    near: NDArray[np.bool_] = dx * dx + dy * dy < radius_m**2
    return near


def _described(points: NDArray[np.float64], normals: NDArray[np.float64], spacing_m: float) -> list[float]:
    """Centre of mass, normal of the regression line towards the free side, length of wall, uncertainty of the centre."""
    centre = points.mean(axis=0)
    away = points - centre
    xx, yy, xy = (away[:, 0] ** 2).mean(), (away[:, 1] ** 2).mean(), (away[:, 0] * away[:, 1]).mean()
    normal_rad = 0.5 * math.atan2(2 * xy, xx - yy) + math.pi / 2
    mean_normal = normals.mean(axis=0)
    if mean_normal[0] * math.cos(normal_rad) + mean_normal[1] * math.sin(normal_rad) < 0:
        normal_rad += math.pi
    spread = math.sqrt(max(xx + yy, 0.0) / 2)
    sigma = math.hypot(0.03, spread / max(len(points), 1))  # a point more or less at the rim shifts the mean by this
    return [float(centre[0]), float(centre[1]), math.remainder(normal_rad, math.tau), len(points) * spacing_m, sigma]
