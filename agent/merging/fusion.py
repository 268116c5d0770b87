"""Many local maps drawn as one: agreement is kept, and a cell on which two robots conflict becomes unknown, as in the paper.

A wall that two robots drew less than a cell apart is no conflict: where a map that calls a cell free has its own wall within
one (coarsest) cell, the finer map decides, and among equals the wall stays.  Everything is a sum, a maximum or a logical or
over the maps, so the order in which robots joined never changes a bit of the result.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from agent.merging.errors import FusionError
from agent.merging.resampling import Lattice, lattice_around, outline_of, resampled
from protocol.geometry import SE2
from protocol.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

MAX_FUSED_CELLS = 50_000_000  # 350 m x 350 m at 5 cm; six bytes a cell while fusing, so 300 MB
MAX_FUSED_SIDE_CELLS = 32_000  # cv2 samples images of fewer than 2^15 rows and columns
_FARTHEST_M = 1e7  # beyond this a transform is a mistake, and doubles no longer hold a cell exactly
_NO_VOTE = 255  # rank of "no map says so"


@dataclass(frozen=True, slots=True, eq=False)
class FusedMap:
    """One grid in the global frame, and how well its sources agree where they overlap."""

    grid: OccupancyGrid
    conflicting_cells: int  # known to two maps or more that contradict each other: unknown in the grid
    agreeing_cells: int  # known to two maps or more that say the same
    conflicts: NDArray[np.bool_]  # (H, W) the conflicting cells
    agreements: NDArray[np.bool_]  # (H, W) the agreeing cells

    @property
    def consistency(self) -> float:
        """Share of the common cells on which the maps agree; 1 when nothing is common."""
        common = self.agreeing_cells + self.conflicting_cells
        return self.agreeing_cells / common if common else 1.0

    @property
    def overlap_m2(self) -> float:
        return (self.agreeing_cells + self.conflicting_cells) * self.grid.resolution_m**2


def fuse(maps: Sequence[tuple[OccupancyGrid, SE2]], resolution_m: float | None = None) -> FusedMap:
    """Draw every (map, T_global_map) into one grid of the global frame; by default at the finest resolution among them."""
    known = [(grid.cropped(), T_global_map) for grid, T_global_map in maps]
    cell_m = resolution_m if resolution_m is not None else min((grid.resolution_m for grid, _ in maps), default=math.nan)
    _check(maps, cell_m)
    known = [(grid, T) for grid, T in known if grid.known().any()]
    if not known:
        return _nothing_known(cell_m)
    lattice = lattice_around(np.concatenate([outline_of(grid, T) for grid, T in known]), cell_m)
    _check_size(lattice, [grid for grid, _ in known])
    votes = _Votes.none(lattice, coarsest_m=max(grid.resolution_m for grid, _ in known))
    ranks = sorted({grid.resolution_m for grid, _ in known})
    for grid, T_global_map in known:
        votes.add(grid, T_global_map, rank=min(ranks.index(grid.resolution_m), _NO_VOTE - 1))
    return votes.decided()


def _check(maps: Sequence[tuple[OccupancyGrid, SE2]], cell_m: float) -> None:
    if not maps:
        raise FusionError("fusing no maps at all: give at least one (map, T_global_map)")
    for i, (grid, T_global_map) in enumerate(maps):
        pose = T_global_map @ grid.origin
        if not (pose.is_finite() and max(abs(pose.x_m), abs(pose.y_m)) < _FARTHEST_M):
            raise FusionError(
                f"map {i} of {len(maps)}: {T_global_map} puts its corner at {pose}; give a finite transform near the origin"
            )
        if not (math.isfinite(grid.resolution_m) and grid.resolution_m > 0):
            raise FusionError(f"map {i} of {len(maps)}: a resolution of {grid.resolution_m} m; it must be positive")
    if not (math.isfinite(cell_m) and cell_m > 0):
        raise FusionError(f"a target resolution of {cell_m} m; it must be positive")


def _check_size(lattice: Lattice, maps: Sequence[OccupancyGrid]) -> None:
    longest = max(max(grid.cells.shape) * max(1.0, grid.resolution_m / lattice.resolution_m) for grid in maps)
    if lattice.cell_count > MAX_FUSED_CELLS or max(lattice.height, lattice.width, 1.5 * longest) > MAX_FUSED_SIDE_CELLS:
        m = lattice.resolution_m
        raise FusionError(
            f"the maps together span {lattice.width * m:.4g} m x {lattice.height * m:.4g} m, "
            f"{lattice.width} x {lattice.height} cells of {m:g} m; the limit is {MAX_FUSED_CELLS:,} cells and "
            f"{MAX_FUSED_SIDE_CELLS:,} a side: fuse at a coarser resolution, or check the transforms"
        )


def _nothing_known(cell_m: float) -> FusedMap:
    grid = OccupancyGrid.empty(cell_m)
    return FusedMap(grid, 0, 0, np.zeros(grid.cells.shape, np.bool_), np.zeros(grid.cells.shape, np.bool_))


@dataclass(frozen=True, slots=True, eq=False)
class _Votes:
    """What the maps drawn so far say about every cell; grows with `add`, whose order does not matter."""

    lattice: Lattice
    tolerance_m: float  # walls this close are the same wall
    voters: NDArray[np.uint8]  # (H, W) maps that know the cell, saturating at 255
    finest_free: NDArray[np.uint8]  # (H, W) smallest rank of a map that says free (0: finest resolution)
    finest_wall: NDArray[np.uint8]  # (H, W) the same for occupied
    surely_free: NDArray[np.bool_]  # (H, W) some map says free, far from any wall of its own

    @staticmethod
    def none(lattice: Lattice, coarsest_m: float) -> _Votes:
        shape = (lattice.height, lattice.width)
        return _Votes(
            lattice,
            max(coarsest_m, lattice.resolution_m),
            np.zeros(shape, np.uint8),
            np.full(shape, _NO_VOTE, np.uint8),
            np.full(shape, _NO_VOTE, np.uint8),
            np.zeros(shape, np.bool_),
        )

    def add(self, grid: OccupancyGrid, T_global_map: SE2, rank: int) -> None:
        margin_m = self.tolerance_m + self.lattice.resolution_m
        part, rows, cols = _window(self.lattice, outline_of(grid, T_global_map), margin_m)
        cells = resampled(grid, T_global_map, part)
        free, wall = cells == FREE, cells == OCCUPIED
        near_wall = _dilated(wall, round(self.tolerance_m / self.lattice.resolution_m))
        voters = self.voters[rows, cols]
        voters += (free | wall) & (voters < 255)
        _keep_smallest(self.finest_free[rows, cols], free, rank)
        _keep_smallest(self.finest_wall[rows, cols], wall, rank)
        self.surely_free[rows, cols] |= free & ~near_wall

    def decided(self) -> FusedMap:
        cell_m = self.lattice.resolution_m
        some_wall = self.finest_wall != _NO_VOTE
        conflicts = some_wall & self.surely_free
        cells = np.full(self.voters.shape, UNKNOWN, np.int8)
        cells[self.finest_free != _NO_VOTE] = FREE
        cells[some_wall & (self.finest_wall <= self.finest_free)] = OCCUPIED
        cells[conflicts] = UNKNOWN
        agreements = (self.voters >= 2) & ~conflicts
        rows, cols = _bounds(self.voters > 0)
        corner = SE2((self.lattice.col0 + cols.start) * cell_m, (self.lattice.row0 + rows.start) * cell_m, 0.0)
        return FusedMap(
            OccupancyGrid(cells[rows, cols], cell_m, corner),
            int(np.count_nonzero(conflicts)),
            int(np.count_nonzero(agreements)),
            conflicts[rows, cols],
            agreements[rows, cols],
        )


def _bounds(mask: NDArray[np.bool_]) -> tuple[slice, slice]:
    """Rows and columns around all True cells; the first cell when there is none."""
    rows, cols = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return slice(0, 1), slice(0, 1)
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(cols[0]), int(cols[-1]) + 1)


def _window(lattice: Lattice, outline_m: NDArray[np.float64], margin_m: float) -> tuple[Lattice, slice, slice]:
    """The part of the lattice around the outline, as a lattice and as slices of the whole."""
    low = np.maximum(lattice.cells_at(outline_m.min(axis=0, keepdims=True) - margin_m)[0], 0)
    high = np.minimum(lattice.cells_at(outline_m.max(axis=0, keepdims=True) + margin_m)[0] + 1, (lattice.height, lattice.width))
    (row, col), (row_end, col_end) = (map(int, low), map(int, high))
    part = Lattice(lattice.resolution_m, lattice.row0 + row, lattice.col0 + col, row_end - row, col_end - col)
    return part, slice(row, row_end), slice(col, col_end)


def _dilated(mask: NDArray[np.bool_], cells: int) -> NDArray[np.bool_]:
    """True within so many cells (a square); a box sum, whose cost does not depend on the size."""
    side = 2 * min(cells, max(mask.shape)) + 1
    sums = cv2.boxFilter(mask.astype(np.uint8), cv2.CV_32S, (side, side), normalize=False, borderType=cv2.BORDER_CONSTANT)
    within: NDArray[np.bool_] = np.greater(sums, 0)
    return within


def _keep_smallest(ranks: NDArray[np.uint8], where: NDArray[np.bool_], rank: int) -> None:
    np.minimum(ranks, np.where(where, np.uint8(rank), np.uint8(_NO_VOTE)), out=ranks)
