"""A map that changed in places: what lies near a change is made again, the rest is carried over, with the same result.

Wall points look no farther than half a metre, and fields tell of no wall that is more than a metre and a half away.  So a
change matters in a box around it, and a campus of which a robot saw one room anew costs little more than finding out which.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from agent.features.field import EDGE_M, MatchField, seen_m
from agent.features.wall_points import MAX_SURFACE_CELLS, WallPoints, reach_cells, surface_cells, wall_points
from agent.features.working import WorkingGrid, shift_between
from protocol.grid import OccupancyGrid

MAX_SHARE = 0.4  # of the map, that a field is made again for; beyond it is cheaper to make all of it
Cell = TypeVar("Cell", np.int32, np.uint8)
Box = tuple[slice, slice]


@dataclass(frozen=True, slots=True, eq=False)
class Change:
    """From one state of a map to a later one on the same lattice."""

    shift: tuple[int, int]  # (rows, columns) that take a working cell to its later place
    changed: NDArray[np.bool_]  # later working cells that were something else

    @staticmethod
    def between(old_grid: OccupancyGrid, old: WorkingGrid, new_grid: OccupancyGrid, new: WorkingGrid) -> Change | None:
        shift = shift_between(old_grid, old, new_grid, new)
        if shift is None:
            return None
        changed = _placed(old.occupied, new.free.shape, shift, fill=0) != new.occupied
        changed |= _placed(old.free, new.free.shape, shift, fill=0) != new.free
        return Change(shift, changed)

    def box(self, margin: int) -> Box:
        """The cells within so many rows and columns of any change; empty when nothing changed."""
        rows, cols = np.flatnonzero(self.changed.any(axis=1)), np.flatnonzero(self.changed.any(axis=0))
        if not len(rows):
            return np.s_[0:0, 0:0]
        return _grown((slice(rows[0], rows[-1] + 1), slice(cols[0], cols[-1] + 1)), margin, self.changed.shape)


def updated_walls(change: Change | None, old: WorkingGrid, old_walls: WallPoints, new: WorkingGrid) -> WallPoints:
    """The same as `wall_points(new)`, reusing what did not change; made afresh where nothing can be reused."""
    if change is None or not len(old_walls):
        return wall_points(new)
    cells = surface_cells(new)
    if max(len(cells), len(old_walls)) >= MAX_SURFACE_CELLS:
        return wall_points(new)
    rows_of_old = _placed(_row_numbers(old.free.shape, old_walls.cells_rc), new.free.shape, change.shift, fill=-1)
    side = 2 * reach_cells(new.resolution_m) + 1
    seen = cv2.dilate(change.changed.view(np.uint8), np.ones((side, side), np.uint8)).view(np.bool_)
    reused = rows_of_old[cells[:, 0], cells[:, 1]]
    reused[seen[cells[:, 0], cells[:, 1]]] = -1
    fresh = wall_points(new, cells[reused < 0])
    return _merged(cells, reused, old_walls, fresh, change.shift, new.resolution_m)


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


def updated_field(
    change: Change | None, old: MatchField, old_walls: WallPoints, new: WorkingGrid, walls: WallPoints
) -> MatchField:
    """The same as `MatchField.of(new, walls)`; made afresh for a map that grew, or of which much changed."""
    if change is None or change.shift != (0, 0) or old.fine.shape != new.free.shape:
        return MatchField.of(new, walls)
    around = math.ceil(max(seen_m(new.resolution_m), 2 * EDGE_M) / new.resolution_m) + 3
    told = change.box(around + reach_cells(new.resolution_m))
    if not _area(told):
        return old
    asked = _grown(told, around, new.free.shape)
    if _area(asked) > MAX_SHARE * new.free.size:
        return MatchField.of(new, walls)
    numbers = _row_numbers(new.free.shape, walls.cells_rc)
    renumbered = np.append(numbers[old_walls.cells_rc[:, 0], old_walls.cells_rc[:, 1]], np.int32(-1))
    fine, coarse, distance_m = old.fine.copy(), old.coarse.copy(), old.distance_m.copy()
    nearest = renumbered.take(old.nearest.astype(np.int32)).astype(np.float32)
    inside = _within(told, asked)
    part = _part(new, walls, numbers, asked)
    fine[told], coarse[told], nearest[told], distance_m[told] = (image[inside] for image in part)
    return MatchField.made_of(fine, coarse, nearest, distance_m, new.resolution_m)


def _part(
    grid: WorkingGrid, walls: WallPoints, numbers: NDArray[np.int32], box: Box
) -> tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.float32], NDArray[np.float32]]:
    """The field's images in a box, right where the box's edge is out of sight."""
    rows = numbers[box][numbers[box] >= 0]
    corner = np.array([box[0].start, box[1].start], np.int32)
    inside = walls.subset(rows.astype(np.int64))
    alone = WallPoints(inside.cells_rc - corner, inside.positions_m, inside.normals, inside.linearity)
    cut = WorkingGrid(np.ascontiguousarray(grid.occupied[box]), np.ascontiguousarray(grid.free[box]), grid.resolution_m)
    field = MatchField.of(cut, alone)
    nearest = np.append(rows, np.int32(-1)).take(field.nearest.astype(np.int32)).astype(np.float32)
    return field.fine, field.coarse, nearest, field.distance_m


def _row_numbers(shape: tuple[int, ...], cells_rc: NDArray[np.int32]) -> NDArray[np.int32]:
    numbers = np.full(shape, -1, np.int32)
    numbers[cells_rc[:, 0], cells_rc[:, 1]] = np.arange(len(cells_rc), dtype=np.int32)
    return numbers


def _grown(box: Box, margin: int, shape: tuple[int, ...]) -> Box:
    if not _area(box):
        return box
    rows, cols = (slice(max(0, s.start - margin), min(size, s.stop + margin)) for s, size in zip(box, shape, strict=True))
    return rows, cols


def _within(inner: Box, outer: Box) -> Box:
    """The inner box as seen from the outer one's corner."""
    rows, cols = (slice(i.start - o.start, i.stop - o.start) for i, o in zip(inner, outer, strict=True))
    return rows, cols


def _area(box: Box) -> int:
    return int((box[0].stop - box[0].start) * (box[1].stop - box[1].start))


def _placed(image: NDArray[Cell], shape: tuple[int, ...], shift: tuple[int, int], fill: int) -> NDArray[Cell]:
    """The image moved by (rows, columns) into a frame of another shape."""
    if shift == (0, 0) and image.shape == shape:
        return image
    out = np.full(shape, fill, image.dtype)
    dr, dc = shift
    r0, c0 = max(0, dr), max(0, dc)
    r1, c1 = min(shape[0], image.shape[0] + dr), min(shape[1], image.shape[1] + dc)
    if r1 > r0 and c1 > c0:
        out[r0:r1, c0:c1] = image[r0 - dr : r1 - dr, c0 - dc : c1 - dc]
    return out
