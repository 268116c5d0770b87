"""What is neither straight nor round: pieces of curve, at three sizes, each told by its centre of mass and regression line.

Cutting a curve where the map happens to end would make every robot see other curves.  So a piece is all the wall within a given
radius of where that wall is densest (mean shift), at each of three radii: two robots that both saw that neighbourhood get the
same piece, wherever the rest of their curves end.  Pieces of one size never share a point.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protocol.features import CURVE_COLUMNS

RADII_M = (0.6, 1.2, 2.4)
MIN_FILL = 1.0  # wall in a piece, in radii: less is a splinter
MAX_POINTS = 2000
MAX_STARTS = 250
MAX_PER_RADIUS = 16
_SHIFTS = 3  # mean-shift steps; most settle in two


def curve_table(points_m: NDArray[np.float64], normals: NDArray[np.float64], spacing_m: float) -> NDArray[np.float32]:
    """(N, 5) `CURVE_COLUMNS` of (N, 2) wall points, each standing for `spacing_m`, whose normals point to the free side."""
    if not len(points_m):
        return np.zeros((0, len(CURVE_COLUMNS)), np.float32)
    stride = -(-len(points_m) // MAX_POINTS)
    points_m, normals, spacing_m = points_m[::stride], normals[::stride], spacing_m * stride
    return np.concatenate([_pieces(points_m, normals, radius_m, spacing_m) for radius_m in RADII_M])


@dataclass(frozen=True, slots=True, eq=False)
class _Squares:
    """Points sorted by the square of a lattice they lie in, so that those near a place are found without asking all."""

    points: NDArray[np.float64]  # (N, 2) sorted
    order: NDArray[np.int64]  # (N,) rows of the points as they came
    keys: NDArray[np.int64]  # (N,) ascending
    low: NDArray[np.float64]  # (2,)
    side_m: float
    columns: int

    @staticmethod
    def of(points: NDArray[np.float64], side_m: float) -> _Squares:
        low = points.min(axis=0) - side_m
        x, y = np.floor((points - low) / side_m).astype(np.int64).T
        columns = int(x.max()) + 2
        keys = y * columns + x
        order = np.argsort(keys, kind="stable")
        return _Squares(points[order], order, keys[order], low, side_m, columns)

    def within_side(self, centres: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Rows (centre, sorted point) of all pairs nearer than a side, by centre."""
        x, y = np.floor((centres - self.low) / self.side_m).astype(np.int64).T
        middle = (y * self.columns + x)[:, None] + self.columns * np.array([-1, 0, 1])
        first, end = np.searchsorted(self.keys, middle - 1), np.searchsorted(self.keys, middle + 1, side="right")
        counts = (end - first).ravel()
        point = np.arange(counts.sum()) + np.repeat(first.ravel() - (np.cumsum(counts) - counts), counts)
        centre = np.repeat(np.arange(len(centres)), (end - first).sum(axis=1))
        away = self.points[point] - centres[centre]
        near = away[:, 0] ** 2 + away[:, 1] ** 2 < self.side_m**2
        return centre[near], point[near]


def _pieces(points: NDArray[np.float64], normals: NDArray[np.float64], radius_m: float, spacing_m: float) -> NDArray[np.float32]:
    """Disjoint pieces of one radius, the fullest first."""
    squares = _Squares.of(points, radius_m)
    centres = _settled(points, squares)
    owner, member = squares.within_side(centres)
    counts = np.bincount(owner, minlength=len(centres))
    starts = np.cumsum(counts) - counts
    free = np.ones(len(points), np.bool_)
    pieces: list[NDArray[np.int64]] = []
    for i in np.lexsort((centres[:, 1], centres[:, 0], -counts)).tolist():
        if len(pieces) == MAX_PER_RADIUS or counts[i] * spacing_m < MIN_FILL * radius_m:
            break
        mine = member[starts[i] : starts[i] + counts[i]]
        if free[mine].all():
            free[mine] = False
            pieces.append(mine)
    if not pieces:
        return np.zeros((0, len(CURVE_COLUMNS)), np.float32)
    rows = np.concatenate(pieces)
    return _described(squares.points[rows], normals[squares.order[rows]], np.array([len(p) for p in pieces]), spacing_m)


def _settled(points: NDArray[np.float64], squares: _Squares) -> NDArray[np.float64]:
    """(K, 2) places where mean shift ends, started from one point in every square of half the radius."""
    square = np.floor(points / (0.5 * squares.side_m)).astype(np.int64)
    _, first = np.unique((square[:, 0] << 32) + square[:, 1], return_index=True)
    centres: NDArray[np.float64] = points[first[:: -(-len(first) // MAX_STARTS)]]
    for _ in range(_SHIFTS):
        owner, member = squares.within_side(centres)
        centres = _means(squares.points[member], owner, len(centres))
    return centres


def _means(values: NDArray[np.float64], owner: NDArray[np.int64], n: int) -> NDArray[np.float64]:
    """(n, 2) mean of the values of every owner."""
    count = np.maximum(np.bincount(owner, minlength=n), 1)
    means: NDArray[np.float64] = np.stack([np.bincount(owner, values[:, k], n) / count for k in (0, 1)], axis=1)
    return means


def _described(
    points: NDArray[np.float64], normals: NDArray[np.float64], sizes: NDArray[np.int64], spacing_m: float
) -> NDArray[np.float32]:
    """Centre of mass, normal of the regression line towards the free side, length of wall, uncertainty of the centre."""
    owner, n = np.repeat(np.arange(len(sizes)), sizes), len(sizes)
    centre = _means(points, owner, n)
    x, y = (points - centre[owner]).T
    xx, yy, xy = (np.bincount(owner, w, n) / sizes for w in (x * x, y * y, x * y))
    normal_rad = 0.5 * np.arctan2(2 * xy, xx - yy) + math.pi / 2
    mean_x, mean_y = _means(normals, owner, n).T
    backwards = mean_x * np.cos(normal_rad) + mean_y * np.sin(normal_rad) < 0
    normal_rad = np.remainder(normal_rad + math.pi * backwards + math.pi, math.tau) - math.pi
    sigma = np.hypot(0.03, np.sqrt(np.maximum(xx + yy, 0.0) / 2) / sizes)  # a point at the rim shifts the mean by this
    return np.column_stack([centre, normal_rad, sizes * spacing_m, sigma]).astype(np.float32)
