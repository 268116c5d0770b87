"""Wall points of a map that grew: those near a change are fitted again, the others are carried over.

Fitting is the dearest step of a snapshot and looks no farther than half a metre, so a map of which a few tiles changed costs
little more than finding out which.
"""

from __future__ import annotations

from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from agent.features.wall_points import MAX_SURFACE_CELLS, WallPoints, reach_cells, surface_cells, wall_points
from agent.features.working import WorkingGrid, shift_between
from protocol.grid import OccupancyGrid

Cell = TypeVar("Cell", np.int32, np.uint8)


def updated_walls(
    old_grid: OccupancyGrid, old: WorkingGrid, old_walls: WallPoints, new_grid: OccupancyGrid, new: WorkingGrid
) -> WallPoints:
    """The same as `wall_points(new)`, reusing what did not change; for maps on one lattice, else made afresh."""
    shift = shift_between(old_grid, old, new_grid, new)
    if shift is None or not len(old_walls):
        return wall_points(new)
    cells = surface_cells(new)
    if max(len(cells), len(old_walls)) >= MAX_SURFACE_CELLS:
        return wall_points(new)
    rows_of_old = _placed(_row_numbers(old.free.shape, old_walls.cells_rc), new.free.shape, shift, fill=-1)
    reused = rows_of_old[cells[:, 0], cells[:, 1]]
    reused[_near_change(old, new, shift)[cells[:, 0], cells[:, 1]]] = -1
    fresh = wall_points(new, cells[reused < 0])
    return _merged(cells, reused, old_walls, fresh, shift, new.resolution_m)


def _merged(
    cells: NDArray[np.int32], reused: NDArray[np.int32], old: WallPoints, fresh: WallPoints, shift: tuple[int, int], cell_m: float
) -> WallPoints:
    offset = np.array([shift[1], shift[0]], np.float32) * np.float32(cell_m)
    carried = reused >= 0
    position, normal, linearity = (
        np.empty((len(cells), 2), np.float32),
        np.empty((len(cells), 2), np.float32),
        np.empty(len(cells), np.float32),
    )
    position[carried], position[~carried] = old.positions_m[reused[carried]] + offset, fresh.positions_m
    normal[carried], normal[~carried] = old.normals[reused[carried]], fresh.normals
    linearity[carried], linearity[~carried] = old.linearity[reused[carried]], fresh.linearity
    return WallPoints(cells, position, normal, linearity)


def _row_numbers(shape: tuple[int, ...], cells_rc: NDArray[np.int32]) -> NDArray[np.int32]:
    numbers = np.full(shape, -1, np.int32)
    numbers[cells_rc[:, 0], cells_rc[:, 1]] = np.arange(len(cells_rc), dtype=np.int32)
    return numbers


def _near_change(old: WorkingGrid, new: WorkingGrid, shift: tuple[int, int]) -> NDArray[np.bool_]:
    """True where a fit could see a cell that changed."""
    changed = _placed(old.occupied, new.free.shape, shift, fill=0) != new.occupied
    changed |= _placed(old.free, new.free.shape, shift, fill=0) != new.free
    side = 2 * reach_cells(new.resolution_m) + 1
    near: NDArray[np.bool_] = cv2.dilate(changed.view(np.uint8), np.ones((side, side), np.uint8)).view(np.bool_)
    return near


def _placed(image: NDArray[Cell], shape: tuple[int, ...], shift: tuple[int, int], fill: int) -> NDArray[Cell]:
    """The image moved by (rows, columns) into a frame of another shape."""
    out = np.full(shape, fill, image.dtype)
    dr, dc = shift
    r0, c0 = max(0, dr), max(0, dc)
    r1, c1 = min(shape[0], image.shape[0] + dr), min(shape[1], image.shape[1] + dc)
    if r1 > r0 and c1 > c0:
        out[r0:r1, c0:c1] = image[r0 - dr : r1 - dr, c0 - dc : c1 - dc]
    return out
