"""Where a scan fits when the first guess may be far off: every pose of a window, scored on a coarse field.

The coarse field has 20 cm cells and a wide kernel, so a search step of one cell does not miss; what it finds is
within the reach of Gauss-Newton.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from agent.mapping.scan_matching import Poses

COARSE_M = 0.2
KERNEL_SIGMA_M = 0.2
KERNEL_RADIUS = 3
GROWTH_CELLS = 64
POINT_VOXEL_M = 0.2


class CoarseField:
    """Mapped end points, blurred: uint8 cells of COARSE_M around the map's origin."""

    def __init__(self) -> None:
        self.first = np.zeros(2, np.int64)  # (row, col) of cells[0, 0], in cells from the map's origin
        self.cells = np.zeros((GROWTH_CELLS, GROWTH_CELLS), np.uint8)
        offsets = np.arange(-KERNEL_RADIUS, KERNEL_RADIUS + 1) * (COARSE_M / KERNEL_SIGMA_M)
        profile = np.exp(-0.5 * offsets**2)
        self.kernel = np.round(255.0 * profile[:, None] * profile[None, :]).astype(np.uint8)

    def stamp(self, points_m: NDArray[np.float32]) -> None:
        """Draw (N, 2) map-frame end points."""
        cells = np.unique(np.floor(points_m[:, ::-1] / COARSE_M).astype(np.int64), axis=0)
        self._cover(cells.min(axis=0) - KERNEL_RADIUS, cells.max(axis=0) + KERNEL_RADIUS + 1)
        rows, cols = (cells - self.first).T
        for row in range(2 * KERNEL_RADIUS + 1):
            for col in range(2 * KERNEL_RADIUS + 1):
                at = rows + (row - KERNEL_RADIUS), cols + (col - KERNEL_RADIUS)
                self.cells[at] = np.maximum(self.cells[at], self.kernel[row, col])

    def _cover(self, low: NDArray[np.int64], high: NDArray[np.int64]) -> None:
        before = np.maximum(self.first - low, 0)
        after = np.maximum(high - (self.first + self.cells.shape), 0)
        if before.any() or after.any():
            before, after = before + GROWTH_CELLS * (before > 0), after + GROWTH_CELLS * (after > 0)
            self.cells = np.pad(self.cells, ((before[0], after[0]), (before[1], after[1])))
            self.first = self.first - before

    def best_poses(
        self, around: Poses, points_m: NDArray[np.float32], reach_m: float, reach_rad: float, n: int
    ) -> tuple[Poses, NDArray[np.float64]]:
        """The n best of all poses within reach of `around` (3,), best first, and the mean field value of each."""
        points = coarse_points(points_m)
        step_rad = min(COARSE_M / max(float(np.hypot(*points.T).max()), 2.0) * 1.5, math.radians(4.0))
        turns = around[2] + np.arange(-math.ceil(reach_rad / step_rad), math.ceil(reach_rad / step_rad) + 1) * step_rad
        half = math.ceil(reach_m / COARSE_M)
        shifts = np.arange(-half, half + 1)
        scores = self._scores(around, points, turns, shifts)
        order = np.argsort(-scores, axis=None, kind="stable")[:n]
        turn, row, col = np.unravel_index(order, scores.shape)
        poses = np.stack([around[0] + shifts[col] * COARSE_M, around[1] + shifts[row] * COARSE_M, turns[turn]], axis=1)
        return poses, scores.ravel()[order]

    def _scores(
        self, around: Poses, points: NDArray[np.float32], turns: NDArray[np.float64], shifts: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """(turns, rows, cols) mean field value in [0, 1]."""
        cos, sin = np.cos(turns)[:, None], np.sin(turns)[:, None]
        x = around[0] + cos * points[:, 0] - sin * points[:, 1]
        y = around[1] + sin * points[:, 0] + cos * points[:, 1]
        pad = int(-shifts[0]) + 1
        height, width = self.cells.shape
        cols = np.clip(np.floor(x / COARSE_M).astype(np.int64) - self.first[1] + pad, pad, width + pad)
        rows = np.clip(np.floor(y / COARSE_M).astype(np.int64) - self.first[0] + pad, pad, height + pad)
        padded = np.pad(self.cells, ((pad, pad + 1), (pad, pad + 1)))
        flat = rows * padded.shape[1] + cols  # (turns, points)
        window = (shifts[:, None] * padded.shape[1] + shifts[None, :]).ravel()
        total = np.zeros((len(turns), len(window)))
        for k, shift in enumerate(window):
            total[:, k] = padded.ravel().take(flat + shift).sum(axis=1, dtype=np.int64)
        return total.reshape(len(turns), len(shifts), len(shifts)) / (255.0 * len(points))


def coarse_points(points_m: NDArray[np.float32], voxel_m: float = POINT_VOXEL_M) -> NDArray[np.float32]:
    """One point a coarse voxel."""
    keys = np.floor(points_m / voxel_m).astype(np.int64)
    _, first = np.unique(keys[:, 0] * 1_000_003 + keys[:, 1], return_index=True)
    return points_m[np.sort(first)]
