"""Wall surfaces as oriented points: where a wall meets free space, which way it runs, and which side is free.

A surface cell is an occupied cell with a free neighbour.  The occupied cells around it give its tangent (principal
component), its position below the cell (on the local line) and its linearity; the free cells around it give the normal its
sign, so normals span the full turn and a corridor's two walls are different things.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from agent.features.working import WorkingGrid

WINDOW_M = 0.45  # radius in which the local line is fitted: shorter is noisy, longer rounds corners off
ACROSS_CELLS = 1.0  # cells of a wall beside a point: more would mix in its far side
SPACING_M = 0.20  # one point stands for this much wall
MAX_THIN_POINTS = 20_000  # 4 km of wall; cv2.remap takes fewer than 2^15 columns
BLOCK = 1024  # cells fitted at a time: what they need stays in cache; 8,192 take half as long again each
MAX_SURFACE_CELLS = 60_000  # a checkerboard is all surface; a 250 m campus has 7,000


@dataclass(frozen=True, eq=False)
class WallPoints:
    """One row a surface cell, in the grid frame."""

    cells_rc: NDArray[np.int32]  # (N, 2)
    positions_m: NDArray[np.float32]  # (N, 2) on the local line
    normals: NDArray[np.float32]  # (N, 2) unit, towards the free side
    linearity: NDArray[np.float32]  # (N,) 0 blob .. 1 line

    def __len__(self) -> int:
        return len(self.cells_rc)

    @cached_property
    def angles_rad(self) -> NDArray[np.float32]:
        """(N,) direction of the normals, [-pi, pi]."""
        angles: NDArray[np.float32] = np.arctan2(self.normals[:, 1], self.normals[:, 0])
        return angles

    @cached_property
    def thin(self) -> NDArray[np.int64]:
        """Rows of one point every `SPACING_M` of wall: the straightest of each voxel."""
        voxel = np.floor(self.positions_m / SPACING_M).astype(np.int64)
        key = (voxel[:, 0] << 32) + voxel[:, 1]
        order = np.lexsort((np.arange(len(key)), -self.linearity, key))
        first = np.ones(len(order), np.bool_)
        first[1:] = np.diff(key[order]) != 0
        rows: NDArray[np.int64] = np.sort(order[first])
        return rows[:: -(-max(1, len(rows)) // MAX_THIN_POINTS)]

    def subset(self, index: NDArray[np.int64]) -> WallPoints:
        return WallPoints(self.cells_rc[index], self.positions_m[index], self.normals[index], self.linearity[index])


def surface_cells(grid: WorkingGrid) -> NDArray[np.int32]:
    """(N, 2) (row, col) of the occupied cells that touch free space."""
    if not grid.free.any():
        return np.zeros((0, 2), np.int32)
    reached = cv2.dilate(grid.free, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0)
    found = cv2.findNonZero(reached & grid.occupied)
    if found is None:
        return np.zeros((0, 2), np.int32)
    cells = found.reshape(-1, 2)[:, ::-1].astype(np.int32)
    stride = -(-len(cells) // MAX_SURFACE_CELLS)
    return np.ascontiguousarray(cells[::stride])


def wall_points(grid: WorkingGrid, cells_rc: NDArray[np.int32] | None = None) -> WallPoints:
    """Oriented points of the given surface cells (default: all of the grid)."""
    cells = surface_cells(grid) if cells_rc is None else cells_rc
    parts = [_fitted(grid, cells[i : i + BLOCK]) for i in range(0, max(1, len(cells)), BLOCK)]
    position, normal, linearity = (np.concatenate([part[k] for part in parts]) for k in range(3))
    return WallPoints(cells, position, normal, linearity)


def _fitted(grid: WorkingGrid, cells: NDArray[np.int32]) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Positions, normals and linearities of some surface cells."""
    offsets, weights = _window(grid.resolution_m)
    around = _around(grid, cells, offsets)
    occupied, free = (around & 1).astype(np.float32), (around >> 1).astype(np.float32)
    y, x = offsets[:, 0] * grid.resolution_m, offsets[:, 1] * grid.resolution_m
    moments = occupied @ (weights[:, None] * np.stack([np.ones_like(x), x, y, x * x, y * y, x * y], axis=1)).astype(np.float32)
    towards_free = free @ np.stack([x, y], axis=1).astype(np.float32)
    normal, linearity = _principal(moments)
    flip = np.sign((towards_free * normal).sum(axis=1, keepdims=True))
    normal = (normal * np.where(flip == 0, 1, flip)).astype(np.float32)
    shift = _shift(occupied, normal, x, y, weights, grid.resolution_m)[:, None] * normal
    positions = (cells[:, ::-1] + np.float32(0.5)) * np.float32(grid.resolution_m) + shift
    return positions.astype(np.float32), normal, linearity


def _around(grid: WorkingGrid, cells: NDArray[np.int32], offsets: NDArray[np.int32]) -> NDArray[np.uint8]:
    """(N, K) the cells of every window: 1 occupied, 2 free, 0 unknown or outside."""
    if not len(cells):
        return np.zeros((0, len(offsets)), np.uint8)
    reach = int(np.abs(offsets).max())
    low, high = cells.min(axis=0), cells.max(axis=0) + 1
    part = np.s_[max(0, low[0] - reach) : high[0] + reach, max(0, low[1] - reach) : high[1] + reach]
    above, left = (max(0, reach - int(v)) for v in low)
    below, right = (max(0, int(v) + reach - size) for v, size in zip(high, grid.free.shape, strict=True))
    seen = np.pad(grid.occupied[part] | (grid.free[part] << 1), ((above, below), (left, right)))
    row, col = (cells - low + reach).T
    middle = row * seen.shape[1] + col
    around: NDArray[np.uint8] = seen.ravel().take(middle[:, None] + (offsets[:, 0] * seen.shape[1] + offsets[:, 1])[None])
    return around


def _shift(
    occupied: NDArray[np.float32],
    normal: NDArray[np.float32],
    x: NDArray[np.floating],
    y: NDArray[np.floating],
    weights: NDArray[np.floating],
    resolution_m: float,
) -> NDArray[np.float32]:
    """(N,) how far the local line lies from the cell's centre along the normal: the mean of the cells beside it.

    Cells farther than a cell across are the other side of the wall, or another wall.
    """
    across = normal @ np.stack([x, y]).astype(np.float32)
    near = occupied * (np.abs(across) <= ACROSS_CELLS * resolution_m) * weights.astype(np.float32)
    shift: NDArray[np.float32] = (near * across).sum(axis=1) / np.maximum(near.sum(axis=1), 1e-6)
    return shift


def reach_cells(resolution_m: float) -> int:
    """How many cells away a fit looks, in rows and columns."""
    return int(max(WINDOW_M, 2.3 * resolution_m) / resolution_m)


def _window(resolution_m: float) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """(K, 2) cell offsets (row, col) within the window and their weights."""
    radius_m = max(WINDOW_M, 2.3 * resolution_m)
    n = reach_cells(resolution_m)
    dy, dx = np.mgrid[-n : n + 1, -n : n + 1]
    d2 = (dx * dx + dy * dy) * (resolution_m / radius_m) ** 2
    keep = d2 <= 1.0
    return np.stack([dy[keep], dx[keep]], axis=1).astype(np.int32), 1.0 - 0.6 * d2[keep]


def _principal(moments: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Unit normal (N, 2) and linearity (N,) from the moments [1, x, y, xx, yy, xy] of the occupied cells."""
    m = np.maximum(moments[:, :1], 1e-6)
    x, y, xx, yy, xy = (moments[:, 1:] / m).T
    cxx, cyy, cxy = xx - x * x, yy - y * y, xy - x * y
    half = np.hypot((cxx - cyy) / 2, cxy)
    tangent = 0.5 * np.arctan2(2 * cxy, cxx - cyy)
    linearity = 2 * half / np.maximum(cxx + cyy, 1e-9)
    normal = np.stack([-np.sin(tangent), np.cos(tangent)], axis=1)
    return normal, linearity.astype(np.float32)


def direction_bins(angles_rad: NDArray[np.floating], bins: int) -> NDArray[np.uint8]:
    """Angles as bin numbers 0 .. bins - 1, bin 0 centred on zero."""
    numbers: NDArray[np.uint8] = (np.rint(angles_rad * (bins / math.tau)).astype(np.int64) % bins).astype(np.uint8)
    return numbers
