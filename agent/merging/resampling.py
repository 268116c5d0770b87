"""One grid drawn on another lattice, turned and shifted by fractions of a cell, without tearing its walls.

Plain nearest-neighbour sampling opens gaps where a one-cell wall runs diagonally, and averaging thins walls away.  So free
space is sampled backwards (an area vote), and walls are carried forwards: every occupied cell marks the cell its centre
falls in, and two touching wall cells that land apart get the cell between them.  Connected walls stay connected.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from protocol.geometry import SE2
from protocol.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

_MAX_SAMPLES = 6  # per axis and cell when shrinking: beyond a factor of six a denser vote changes nothing that matters
_BITS = 32  # of a cell: 32,000 cells further the error is a hundred-thousandth of a cell
_SIDE = 32_766  # beyond every source image that cv2 takes
_UNKNOWN_BYTE = UNKNOWN & 0xFF
_BAND_ROWS = 64  # sampled at a time: the indices of a whole map take thirty times its own memory
_NEIGHBOURS = ((0, 1), (1, 0), (1, 1), (1, -1))  # each touching pair of cells once, (row, col)


@dataclass(frozen=True, slots=True)
class Lattice:
    """Square cells parallel to the axes of the target frame: (0, 0) has its lower-left corner at (col0, row0) cells."""

    resolution_m: float
    row0: int
    col0: int
    height: int
    width: int

    @property
    def origin(self) -> SE2:
        return SE2(self.col0 * self.resolution_m, self.row0 * self.resolution_m, 0.0)

    def cells_at(self, points_m: NDArray[np.float64]) -> NDArray[np.int64]:
        """(N, 2) (row, col) of (N, 2) target-frame points."""
        return np.floor(points_m[:, ::-1] / self.resolution_m).astype(np.int64) - (self.row0, self.col0)

    @property
    def cell_count(self) -> int:
        return self.height * self.width


def lattice_around(corners_m: NDArray[np.float64], resolution_m: float) -> Lattice:
    """The smallest lattice that holds (N, 2) target-frame points, with one cell of margin.

    Its lines pass through the frame's origin, so a map that grows never shifts the cells it already had.
    """
    low = np.floor(corners_m.min(axis=0) / resolution_m) - 1
    high = np.ceil(corners_m.max(axis=0) / resolution_m) + 1
    (col0, row0), (width, height) = low, high - low
    return Lattice(resolution_m, int(row0), int(col0), int(height), int(width))


def outline_of(grid: OccupancyGrid, T_target_map: SE2) -> NDArray[np.float64]:
    """(N, 2) target-frame corners of the first and last known cell of every row: all that is known lies in their hull.

    A turned map's own rectangle has corners where nothing is known, and would make the target several times too large.
    """
    known = grid.known()
    rows = np.flatnonzero(known.any(axis=1))
    first, last = known[rows].argmax(axis=1), grid.width - known[rows, ::-1].argmax(axis=1)
    cells = np.concatenate([np.column_stack([col, row]) for col in (first, last) for row in (rows, rows + 1)])
    return (T_target_map @ grid.origin).apply(cells * grid.resolution_m)


def resampled(grid: OccupancyGrid, T_target_map: SE2, lattice: Lattice) -> NDArray[np.int8]:
    """(height, width) trinary cells of the grid on the lattice."""
    source = _subdivided(grid, lattice.resolution_m)
    T_target_grid = T_target_map @ source.origin
    free, occupied = _area_vote(source, T_target_grid, lattice)
    walls = _carried_walls(source, T_target_grid, lattice)
    cells = np.where(free, FREE, UNKNOWN).astype(np.int8)
    cells[walls | (occupied & _enclosed(walls))] = OCCUPIED
    return cells


def resampled_like(target: OccupancyGrid, grid: OccupancyGrid, T_target_map: SE2) -> NDArray[np.int8]:
    """Cells of the grid on the lattice of `target`, a fused grid: parallel to its frame, its lines through the origin."""
    cell_m = target.resolution_m
    lattice = Lattice(cell_m, round(target.origin.y_m / cell_m), round(target.origin.x_m / cell_m), target.height, target.width)
    return resampled(grid, T_target_map, lattice)


def _subdivided(grid: OccupancyGrid, resolution_m: float) -> OccupancyGrid:
    """The same map with cells no larger than the target's."""
    factor = math.ceil(grid.resolution_m / resolution_m - 1e-6)
    if factor <= 1:
        return grid
    cells = np.repeat(np.repeat(grid.cells, factor, axis=0), factor, axis=1)
    return OccupancyGrid(cells, grid.resolution_m / factor, grid.origin)


@dataclass(frozen=True, slots=True, eq=False)
class _CellMotion:
    """Where cells of one raster fall in another, in whole numbers: every processor finds the same cell, to the last bit.

    cv2's own warping rounds differently with and without vector units, and robots compare hashes of the maps they fuse.
    """

    steps: NDArray[np.int64]  # (2, 3) rows x and y; columns per half column, per half row, offset; in 2^-_BITS of a cell

    @staticmethod
    def of(T_to_from: SE2, from_m: float, to_m: float, from_cell: tuple[int, int], to_cell: tuple[int, int]) -> _CellMotion:
        """Cells of `from_m` in one frame to cells of `to_m` in another; the cells are (col, row) of the rasters' corners."""
        linear = T_to_from.rotation() * (from_m / to_m)
        offset = np.array([T_to_from.x_m, T_to_from.y_m]) / to_m + linear @ from_cell - to_cell
        return _CellMotion(np.rint(np.column_stack([linear / 2, offset]) * (1 << _BITS)).astype(np.int64))

    def at(self, half_cols: NDArray[np.int64], half_rows: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """(row, col) of points given in half cells, so that a cell's centre has odd numbers; arrays broadcast."""
        (ax, bx, cx), (ay, by, cy) = self.steps
        return (ay * half_cols + (by * half_rows + cy)) >> _BITS, (ax * half_cols + (bx * half_rows + cx)) >> _BITS


def _area_vote(source: OccupancyGrid, T_target_grid: SE2, lattice: Lattice) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Cells mostly free, and cells with any wall sample, by backward sampling on a small raster within each cell."""
    n = min(_MAX_SAMPLES, max(1, math.ceil(lattice.resolution_m / source.resolution_m - 1e-6)))
    image = np.ascontiguousarray(source.cells).view(np.uint8)
    motion = _CellMotion.of(
        T_target_grid.inverse(), lattice.resolution_m / n, source.resolution_m, (lattice.col0 * n, lattice.row0 * n), (0, 0)
    )
    free = np.zeros((lattice.height, lattice.width), np.uint8)
    occupied = np.zeros_like(free)
    for first in range(0, lattice.height, _BAND_ROWS):
        band = slice(first, min(first + _BAND_ROWS, lattice.height))
        for i in range(n * n):
            half_cols = 2 * (n * np.arange(lattice.width) + i % n) + 1
            half_rows = 2 * (n * np.arange(band.start, band.stop) + i // n) + 1
            seen = _seen(image, *motion.at(half_cols[None, :], half_rows[:, None]))
            free[band] += seen == FREE
            occupied[band] += seen == OCCUPIED
    return 2 * free.astype(np.int16) >= n * n, occupied > 0


def _seen(image: NDArray[np.uint8], row: NDArray[np.int64], col: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Values under (row, col), unknown outside."""
    there = cv2.merge([np.clip(at, -1, _SIDE).astype(np.int16) for at in (col, row)])  # np.stack takes nine times as long
    seen = cv2.remap(image, there, None, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=_UNKNOWN_BYTE)
    return np.asarray(seen, np.uint8)


def _carried_walls(source: OccupancyGrid, T_target_grid: SE2, lattice: Lattice) -> NDArray[np.bool_]:
    """Target cells that hold the centre of a wall cell, or bridge two touching wall cells that landed apart."""
    motion = _CellMotion.of(T_target_grid, source.resolution_m, lattice.resolution_m, (0, 0), (lattice.col0, lattice.row0))
    walls = np.zeros((lattice.height, lattice.width), np.bool_)
    padded = np.pad(source.cells == OCCUPIED, 1)
    cells = _true_cells(padded) - 1
    _mark(walls, _landed(motion, 2 * cells + 1))
    for step in np.array(_NEIGHBOURS):
        beside = cells + step + 1
        first = 2 * cells[padded[beside[:, 0], beside[:, 1]]] + 1
        a, b = _landed(motion, first), _landed(motion, first + 2 * step)
        apart = np.abs(a - b).max(axis=1, initial=0) > 1
        _mark(walls, _landed(motion, first[apart] + step))
    return walls


def _true_cells(mask: NDArray[np.bool_]) -> NDArray[np.int64]:
    """(N, 2) (row, col); ten times faster than numpy's own on sparse masks."""
    found = cv2.findNonZero(mask.view(np.uint8))
    return np.zeros((0, 2), np.int64) if found is None else found.reshape(-1, 2)[:, ::-1].astype(np.int64)


def _landed(motion: _CellMotion, half_cells_rc: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.stack(motion.at(half_cells_rc[:, 1], half_cells_rc[:, 0]), axis=1)


def _mark(mask: NDArray[np.bool_], cells_rc: NDArray[np.int64]) -> None:
    inside = ((cells_rc >= 0) & (cells_rc < mask.shape)).all(axis=1)
    mask[cells_rc[inside, 0], cells_rc[inside, 1]] = True


def _enclosed(walls: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Cells with walls on three sides or more: pinholes that turning a thick wall leaves."""
    cross = np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]], np.uint8)
    sides = cv2.filter2D(walls.astype(np.uint8), cv2.CV_8U, cross, borderType=cv2.BORDER_CONSTANT)
    pinholes: NDArray[np.bool_] = np.greater_equal(sides, 3)
    return pinholes
