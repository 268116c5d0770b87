"""The grid that matching works on: cells of about 10 cm, whatever the map's own resolution, padded with the unknown.

Positions here are in the *grid frame*: metres from the lower-left corner of the map's cell (0, 0), along its own axes.  Only
`MapSnapshot` knows where that corner lies in the map frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.grid import FREE, OCCUPIED, OccupancyGrid

WORKING_RESOLUTION_M = 0.10  # finer cells cost four times the work and gain no accuracy: walls are fitted below the cell
MAX_WORKING_SIDE = 32_000  # cv2.remap reads images of fewer than 2^15 rows and columns
MAX_WORKING_CELLS = 16_000_000  # a 400 m square; larger maps are worked on with coarser cells


@dataclass(frozen=True, slots=True, eq=False)
class WorkingGrid:
    """Occupied and free as 0/1 images, `resolution_m` a cell, a multiple of the map's."""

    occupied: NDArray[np.uint8]  # (H, W)
    free: NDArray[np.uint8]  # (H, W)
    resolution_m: float

    @staticmethod
    def of(grid: OccupancyGrid) -> WorkingGrid:
        factor = _factor(grid)
        occupied = (grid.cells == OCCUPIED).view(np.uint8)
        free = (grid.cells == FREE).view(np.uint8)
        if factor > 1:
            occupied = _block_sums(occupied, factor) > 0
            free = (_block_sums(free, factor) >= (factor * factor + 1) // 2) & ~occupied
        return WorkingGrid(
            np.ascontiguousarray(occupied).view(np.uint8),
            np.ascontiguousarray(free).view(np.uint8),
            grid.resolution_m * factor,
        )


def _factor(grid: OccupancyGrid) -> int:
    factor = max(1, int(WORKING_RESOLUTION_M / grid.resolution_m + 1e-6))
    while grid.cells.size > MAX_WORKING_CELLS * factor * factor or max(grid.cells.shape) > MAX_WORKING_SIDE * factor:
        factor += 1
    return factor


def _block_sums(mask: NDArray[np.uint8], k: int) -> NDArray[Any]:
    """Sums over k x k blocks; the last row and column of blocks may hang over the edge."""
    h, w = mask.shape
    padded = np.pad(mask, ((0, -h % k), (0, -w % k))) if h % k or w % k else mask
    of_rows = padded[::k].astype(np.uint8 if k * k < 256 else np.int32)
    for row in range(1, k):
        np.add(of_rows, padded[row::k], out=of_rows)
    sums = of_rows[:, ::k].copy()
    for col in range(1, k):
        np.add(sums, of_rows[:, col::k], out=sums)
    return sums


def shift_between(old_grid: OccupancyGrid, old: WorkingGrid, new_grid: OccupancyGrid, new: WorkingGrid) -> tuple[int, int] | None:
    """(rows, columns) that take a working cell of the old map to the new one; None when they lie on different lattices."""
    if old_grid.resolution_m != new_grid.resolution_m or old.resolution_m != new.resolution_m:
        return None
    T_new_old = new_grid.origin.inverse() @ old_grid.origin
    rows, cols = T_new_old.y_m / new.resolution_m, T_new_old.x_m / new.resolution_m
    if abs(T_new_old.theta_rad) > 1e-12 or max(abs(rows - round(rows)), abs(cols - round(cols))) > 1e-6:
        return None
    return round(rows), round(cols)
