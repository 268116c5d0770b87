"""Where a scan fits when the first guess may be far off: every pose of a window, scored on a coarse field.

The coarse field has 20 cm cells and a wide kernel, so a search step of one cell does not miss; what it finds is
within the reach of scan matching on the fine field.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from agent.mapping.scan_matching import Poses

COARSE_M = 0.2
KERNEL_SIGMA = 1.0  # coarse cells
GROWTH_CELLS = 64
LARGEST_TURN_STEP_RAD = math.radians(4.0)
MARGIN_CELLS = 3  # around what a search may touch: the kernel's reach


class CoarseField:
    """Cells of COARSE_M that hold a mapped end point; blurred only where and when a search looks."""

    def __init__(self) -> None:
        self.first = np.zeros(2, np.int64)  # (row, col) of empty[0, 0], in cells from the map's origin
        self.empty = np.ones((GROWTH_CELLS, GROWTH_CELLS), np.uint8)  # 0 where an end point lies

    def stamp(self, points_m: NDArray[np.float32]) -> None:
        """Draw (N, 2) map-frame end points."""
        cells = np.floor(points_m[:, ::-1] / COARSE_M).astype(np.int64)
        self._cover(cells.min(axis=0), cells.max(axis=0) + 1)
        rows, cols = (cells - self.first).T
        self.empty[rows, cols] = 0

    def _cover(self, low: NDArray[np.int64], high: NDArray[np.int64]) -> None:
        before = np.maximum(self.first - low, 0)
        after = np.maximum(high - (self.first + self.empty.shape), 0)
        if before.any() or after.any():
            before, after = before + GROWTH_CELLS * (before > 0), after + GROWTH_CELLS * (after > 0)
            self.empty = np.pad(self.empty, ((before[0], after[0]), (before[1], after[1])), constant_values=1)
            self.first = self.first - before

    def blurred(self, low: NDArray[np.int64], high: NDArray[np.int64]) -> NDArray[np.float32]:
        """Field in [0, 1] of cells [low, high), (row, col) from the map's origin; 0 outside what is known."""
        window = np.ones(high - low, np.uint8)
        inner_low = np.maximum(low, self.first)
        inner_high = np.minimum(high, self.first + self.empty.shape)
        if (inner_low < inner_high).all():
            (a, b), (c, d) = inner_low - low, inner_high - low
            (e, f), (g, h) = inner_low - self.first, inner_high - self.first
            window[a:c, b:d] = self.empty[e:g, f:h]
        if window.all():
            return np.zeros(window.shape, np.float32)
        cells = cv2.distanceTransform(window, cv2.DIST_L2, 3)
        return np.asarray(np.exp(cells**2 * np.float32(-0.5 / KERNEL_SIGMA**2)), np.float32)

    def best_poses(
        self, around: NDArray[np.float64], points_m: NDArray[np.float32], reach_m: float, reach_rad: float, n: int
    ) -> tuple[Poses, NDArray[np.float64]]:
        """The n best of all poses within reach of `around` (3,), best first, and the mean field value of each."""
        points = coarse_points(points_m)
        turns = around[2] + turn_steps(points, reach_rad)
        half = math.ceil(reach_m / COARSE_M)
        scores = self._scores(around, points, turns, half)
        order = np.argsort(-scores, axis=None, kind="stable")[:n]
        turn, row, col = np.unravel_index(order, scores.shape)
        poses = np.stack([around[0] + (col - half) * COARSE_M, around[1] + (row - half) * COARSE_M, turns[turn]], axis=1)
        return poses, scores.ravel()[order]

    def _scores(
        self, around: NDArray[np.float64], points: NDArray[np.float32], turns: NDArray[np.float64], half: int
    ) -> NDArray[np.float64]:
        """(turns, 2 half + 1, 2 half + 1) mean field value: rows shift y, columns shift x."""
        cos, sin = np.cos(turns)[:, None], np.sin(turns)[:, None]
        rows = np.floor((around[1] + sin * points[:, 0] + cos * points[:, 1]) / COARSE_M).astype(np.int64)
        cols = np.floor((around[0] + cos * points[:, 0] - sin * points[:, 1]) / COARSE_M).astype(np.int64)
        low = np.array([rows.min(), cols.min()]) - half - MARGIN_CELLS
        high = np.array([rows.max(), cols.max()]) + half + MARGIN_CELLS + 1
        field = self.blurred(low, high)
        flat = (rows - low[0]) * field.shape[1] + (cols - low[1])
        shifts = np.arange(-half, half + 1)
        windows = [field.ravel().take(flat + (row * field.shape[1] + col)).mean(axis=1) for row in shifts for col in shifts]
        return np.stack(windows, axis=1).reshape(len(turns), len(shifts), len(shifts)).astype(np.float64)


def turn_steps(points_m: NDArray[np.float32], reach_rad: float) -> NDArray[np.float64]:
    """Turns from -reach to reach, so fine that the farthest point moves by one and a half cells."""
    farthest_m = max(float(np.hypot(points_m[:, 0], points_m[:, 1]).max()), 2.0)
    step_rad = min(1.5 * COARSE_M / farthest_m, LARGEST_TURN_STEP_RAD)
    half = math.ceil(reach_rad / step_rad)
    return np.arange(-half, half + 1, dtype=np.float64) * step_rad


def coarse_points(points_m: NDArray[np.float32], voxel_m: float = COARSE_M) -> NDArray[np.float32]:
    """One point a coarse voxel."""
    keys = np.floor(points_m / voxel_m).astype(np.int64)
    _, first = np.unique(keys[:, 0] * 1_000_003 + keys[:, 1], return_index=True)
    return points_m[np.sort(first)]
