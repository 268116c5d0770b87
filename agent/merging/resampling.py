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


def corners_of(grid: OccupancyGrid, T_target_map: SE2) -> NDArray[np.float64]:
    """(4, 2) target-frame corners of the grid's rectangle."""
    w, h = grid.width * grid.resolution_m, grid.height * grid.resolution_m
    return (T_target_map @ grid.origin).apply([(0.0, 0.0), (w, 0.0), (w, h), (0.0, h)])


def resampled(grid: OccupancyGrid, T_target_map: SE2, lattice: Lattice) -> NDArray[np.int8]:
    """(height, width) trinary cells of the grid on the lattice."""
    source = _subdivided(grid, lattice.resolution_m)
    T_target_grid = T_target_map @ source.origin
    free, occupied = _area_vote(source, T_target_grid, lattice)
    walls = _carried_walls(source, T_target_grid, lattice)
    cells = np.where(free, FREE, UNKNOWN).astype(np.int8)
    cells[walls | (occupied & _enclosed(walls))] = OCCUPIED
    return cells


def _subdivided(grid: OccupancyGrid, resolution_m: float) -> OccupancyGrid:
    """The same map with cells no larger than the target's."""
    factor = math.ceil(grid.resolution_m / resolution_m - 1e-6)
    if factor <= 1:
        return grid
    cells = np.repeat(np.repeat(grid.cells, factor, axis=0), factor, axis=1)
    return OccupancyGrid(cells, grid.resolution_m / factor, grid.origin)


def _area_vote(source: OccupancyGrid, T_target_grid: SE2, lattice: Lattice) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Cells mostly free, and cells with any wall sample, by backward sampling on a small raster within each cell."""
    n = min(_MAX_SAMPLES, max(1, math.ceil(lattice.resolution_m / source.resolution_m - 1e-6)))
    image = np.select([source.cells == FREE, source.cells == OCCUPIED], [1, 2], 0).astype(np.uint8)
    free = np.zeros((lattice.height, lattice.width), np.uint8)
    occupied = np.zeros_like(free)
    for i in range(n * n):
        offset = ((i % n + 0.5) / n, (i // n + 0.5) / n)
        seen = _sampled(image, _pixel_map(T_target_grid, source.resolution_m, lattice, offset), free.shape)
        free += seen == 1
        occupied += seen == 2
    return 2 * free.astype(np.int16) >= n * n, occupied > 0


def _pixel_map(
    T_target_grid: SE2, source_resolution_m: float, lattice: Lattice, offset: tuple[float, float]
) -> NDArray[np.float64]:
    """(2, 3) target pixel -> source pixel, for the point at `offset` (0..1) within each target cell.

    The centre of cv2's pixel k lies at k, that of our cell k at k + 0.5.
    """
    T_grid_target = T_target_grid.inverse().matrix()
    to_metres = np.array(
        [
            [lattice.resolution_m, 0.0, (lattice.col0 + offset[0]) * lattice.resolution_m],
            [0.0, lattice.resolution_m, (lattice.row0 + offset[1]) * lattice.resolution_m],
            [0.0, 0.0, 1.0],
        ]
    )
    M: NDArray[np.float64] = (T_grid_target @ to_metres)[:2] / source_resolution_m
    M[:, 2] -= 0.5
    return M


def _sampled(image: NDArray[np.uint8], M: NDArray[np.float64], shape: tuple[int, ...]) -> NDArray[np.uint8]:
    flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    out: NDArray[np.uint8] = cv2.warpAffine(image, M, (shape[1], shape[0]), flags=flags, borderValue=0)
    return out


def _carried_walls(source: OccupancyGrid, T_target_grid: SE2, lattice: Lattice) -> NDArray[np.bool_]:
    """Target cells that hold the centre of a wall cell, or bridge two touching wall cells that landed apart."""
    walls = np.zeros((lattice.height, lattice.width), np.bool_)
    wall = source.cells == OCCUPIED
    _mark(walls, _landed(np.argwhere(wall), source.resolution_m, T_target_grid, lattice))
    for dr, dc in _NEIGHBOURS:
        first = _first_of_touching_pairs(wall, dr, dc)
        a = _landed(first, source.resolution_m, T_target_grid, lattice)
        b = _landed(first + np.array([dr, dc]), source.resolution_m, T_target_grid, lattice)
        apart = np.abs(a - b).max(axis=1, initial=0) > 1
        middle = first[apart] + np.array([dr / 2, dc / 2])
        _mark(walls, _landed(middle, source.resolution_m, T_target_grid, lattice))
    return walls


def _first_of_touching_pairs(wall: NDArray[np.bool_], dr: int, dc: int) -> NDArray[np.int64]:
    """(N, 2) occupied cells whose neighbour at (dr, dc) is occupied too."""
    h, w = wall.shape
    here, there = wall[: h - dr, max(0, -dc) : w - max(0, dc)], wall[dr:, max(0, dc) : w - max(0, -dc)]
    first: NDArray[np.int64] = np.argwhere(here & there) + np.array([0, max(0, -dc)])
    return first


def _landed(cells_rc: NDArray[np.generic], resolution_m: float, T_target_grid: SE2, lattice: Lattice) -> NDArray[np.int64]:
    points = (cells_rc.astype(np.float64)[:, ::-1] + 0.5) * resolution_m
    return lattice.cells_at(T_target_grid.apply(points))


def _mark(mask: NDArray[np.bool_], cells_rc: NDArray[np.int64]) -> None:
    inside = ((cells_rc >= 0) & (cells_rc < mask.shape)).all(axis=1)
    mask[cells_rc[inside, 0], cells_rc[inside, 1]] = True


def _enclosed(walls: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Cells with walls on three sides or more: pinholes that turning a thick wall leaves."""
    cross = np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]], np.uint8)
    sides = cv2.filter2D(walls.astype(np.uint8), cv2.CV_8U, cross, borderType=cv2.BORDER_CONSTANT)
    pinholes: NDArray[np.bool_] = np.greater_equal(sides, 3)
    return pinholes


def resampled_like(target: OccupancyGrid, grid: OccupancyGrid, T_target_map: SE2) -> NDArray[np.int8]:
    """Cells of the grid on the lattice of `target`, a fused grid: parallel to its frame, its lines through the origin."""
    cell_m = target.resolution_m
    lattice = Lattice(cell_m, round(target.origin.y_m / cell_m), round(target.origin.x_m / cell_m), target.height, target.width)
    return resampled(grid, T_target_map, lattice)
