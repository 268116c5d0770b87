"""Where a robot fits, and the way from one place to another: the true world on a coarse grid.

Only simulated robots and world generators use this; nothing here ever reaches a mapper.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from hw.errors import DeviceConfigError
from protocol.geometry import SE2

if TYPE_CHECKING:
    from hw.sim.world import World

Cell = tuple[int, int]
START_CLEARANCE_M = 0.5
SWEEPS = 8  # of a whole grid between two looks whether anything still changes
_NEIGHBOURS = [(r, c, math.hypot(r, c)) for r in (-1, 0, 1) for c in (-1, 0, 1) if r or c]


@dataclass(frozen=True, eq=False)
class Clearance:
    """Distance to the nearest wall, for every cell of the inside of a world."""

    walls: NDArray[np.uint8]  # (H, W) 0 where a wall passes or outside, 1 elsewhere
    metres: NDArray[np.float32]  # (H, W)
    resolution_m: float
    left_m: float
    bottom_m: float

    @staticmethod
    def of(world: World, resolution_m: float = 0.1) -> Clearance:
        from hw.sim.world import sample_walls  # noqa: PLC0415  (world imports this module for its starts)

        x0, y0, x1, y1 = world.bounds
        left, bottom = x0 - 2.5 * resolution_m, y0 - 2.5 * resolution_m
        shape = (math.ceil((y1 - bottom) / resolution_m) + 3, math.ceil((x1 - left) / resolution_m) + 3)
        empty = Clearance(np.ones(shape, np.uint8), np.zeros(shape, np.float32), resolution_m, left, bottom)
        drawn = empty.with_walls(sample_walls(world.segments, resolution_m / 2)).walls
        _, labels = cv2.connectedComponents(drawn, connectivity=4)
        drawn[labels == labels[0, 0]] = 0
        return empty._of_walls(drawn)

    def with_walls(self, points_m: NDArray[np.float64]) -> Clearance:
        """The same place with more wall, given as dense points."""
        rows = ((points_m[:, 1] - self.bottom_m) / self.resolution_m).astype(np.int64).clip(0, self.walls.shape[0] - 1)
        cols = ((points_m[:, 0] - self.left_m) / self.resolution_m).astype(np.int64).clip(0, self.walls.shape[1] - 1)
        walls = self.walls.copy()
        walls[rows, cols] = 0
        return self._of_walls(walls)

    def _of_walls(self, walls: NDArray[np.uint8]) -> Clearance:
        metres = cv2.distanceTransform(walls, cv2.DIST_L2, 5) * self.resolution_m
        return Clearance(walls, metres.astype(np.float32), self.resolution_m, self.left_m, self.bottom_m)

    def is_one_place(self, radius_m: float) -> bool:
        """True when a disc of this radius can get from any place it fits to any other, but for nooks under a square metre."""
        _, _, stats, _ = cv2.connectedComponentsWithStats((self.metres > radius_m).astype(np.uint8), connectivity=4)
        areas = np.sort(stats[1:, cv2.CC_STAT_AREA]) * self.resolution_m**2
        return len(areas) > 0 and bool(np.all(areas[:-1] < 1.0))

    def main_place(self, radius_m: float) -> NDArray[np.bool_]:
        """(H, W) the largest connected area in which a disc of this radius fits."""
        _, labels, stats, _ = cv2.connectedComponentsWithStats((self.metres > radius_m).astype(np.uint8), connectivity=4)
        if len(stats) < 2:
            return np.zeros(self.walls.shape, bool)
        return np.asarray(labels == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA])))

    def cell(self, x_m: float, y_m: float) -> Cell:
        row, col = int((y_m - self.bottom_m) / self.resolution_m), int((x_m - self.left_m) / self.resolution_m)
        return min(max(row, 0), self.walls.shape[0] - 1), min(max(col, 0), self.walls.shape[1] - 1)

    def point(self, cell: Cell) -> tuple[float, float]:
        return self.left_m + (cell[1] + 0.5) * self.resolution_m, self.bottom_m + (cell[0] + 0.5) * self.resolution_m

    def at(self, x_m: float, y_m: float) -> float:
        """Clearance at a point, bilinear enough for steering: the cell's."""
        return float(self.metres[self.cell(x_m, y_m)])

    def is_straight_way(self, a: tuple[float, float], b: tuple[float, float], radius_m: float) -> bool:
        """True when a disc can slide from a to b in a straight line."""
        n = max(2, math.ceil(math.hypot(b[0] - a[0], b[1] - a[1]) / self.resolution_m) + 1)
        rows = ((np.linspace(a[1], b[1], n) - self.bottom_m) / self.resolution_m).astype(np.int64)
        cols = ((np.linspace(a[0], b[0], n) - self.left_m) / self.resolution_m).astype(np.int64)
        return bool(np.all(self.metres[rows, cols] > radius_m))


class Ways:
    """Shortest ways over a clearance grid, keeping off walls where there is room."""

    def __init__(self, clearance: Clearance, radius_m: float) -> None:
        self.clearance = clearance
        self._passable = clearance.main_place(radius_m)
        narrow = np.maximum(0.0, 0.6 - clearance.metres)
        cost = (1.0 + 4.0 * narrow) * clearance.resolution_m  # per cell entered
        self._cost = np.where(self._passable, cost, np.inf).astype(np.float32)

    def lengths_from(self, start: tuple[float, float], most: float = math.inf) -> NDArray[np.float32]:
        """(H, W) cost of the way from start to each cell, `inf` beyond `most`: every cell asks its neighbours until none gains.

        A whole-array sweep is several times faster here than a queue of single cells.
        """
        lengths: NDArray[np.float32] = np.full(self._passable.shape, np.inf, np.float32)
        lengths[self._nearest_passable(self.clearance.cell(*start))] = 0.0
        inner = lengths[1:-1, 1:-1]
        height, width = lengths.shape
        views = [
            (lengths[1 + r : height - 1 + r, 1 + c : width - 1 + c], self._cost[1:-1, 1:-1] * np.float32(d))
            for r, c, d in _NEIGHBOURS
        ]
        while True:
            before = inner.copy()
            for neighbours, cost in views * SWEEPS:
                np.minimum(inner, neighbours + cost, out=inner)
            if np.all((inner == before) | (inner > most)):
                break
        return np.where(lengths <= most, lengths, np.float32(np.inf))

    def path(self, lengths: NDArray[np.float32], goal: Cell, radius_m: float) -> list[tuple[float, float]]:
        """Corner points from where `lengths` starts to the goal, pulled straight where a disc can slide."""
        cells = [goal]
        while lengths[cells[-1]] > 0:
            row, col = cells[-1]
            cells.append(min(((row + r, col + c) for r, c, _ in _NEIGHBOURS), key=lambda cell: float(lengths[cell])))
        points = [self.clearance.point(cell) for cell in reversed(cells)]
        path, at = [points[0]], 0
        while at < len(points) - 1:
            reach = at + 1
            for ahead in range(min(len(points) - 1, at + 60), at + 1, -3):
                if self.clearance.is_straight_way(points[at], points[ahead], radius_m):
                    reach = ahead
                    break
            path.append(points[reach])
            at = reach
        return path

    def _nearest_passable(self, cell: Cell) -> Cell:
        if self._passable[cell]:
            return cell
        rows, cols = np.nonzero(self._passable)
        i = int(np.argmin((rows - cell[0]) ** 2 + (cols - cell[1]) ** 2))
        return int(rows[i]), int(cols[i])


def spread_starts(world: World, n: int, seed: int, spacing_m: float) -> list[SE2]:
    """n free places, each about `spacing_m` of way from the nearest of those before it."""
    rng = np.random.default_rng([11, seed])
    clearance = Clearance.of(world, 0.2)
    ways = Ways(clearance, START_CLEARANCE_M)
    rows, cols = np.nonzero(clearance.main_place(START_CLEARANCE_M))
    if not len(rows):
        raise DeviceConfigError(
            f"{world.name}: no place to start, {START_CLEARANCE_M:g} m off every wall; are the walls closed? "
            "else say where: --pose x,y,degrees, or a line 'start x y degrees'"
        )
    x0, y0, x1, y1 = world.bounds
    middle = clearance.cell((x0 + x1) / 2 + rng.normal(0, 2), (y0 + y1) / 2 + rng.normal(0, 1))
    first = int(np.argmin((rows - middle[0]) ** 2 + (cols - middle[1]) ** 2))
    chosen = [(int(rows[first]), int(cols[first]))]
    nearest = ways.lengths_from(clearance.point(chosen[0]))[rows, cols]
    while len(chosen) < n:
        misfit = np.abs(nearest - spacing_m) + rng.uniform(0, 0.8, len(nearest))
        i = int(np.argmin(np.where(np.isfinite(nearest), misfit, 1e9)))
        chosen.append((int(rows[i]), int(cols[i])))
        nearest = np.minimum(nearest, ways.lengths_from(clearance.point(chosen[-1]))[rows, cols])
    poses = []
    for cell in chosen:
        x, y = clearance.point(cell)
        poses.append(SE2(x, y, float(rng.uniform(-math.pi, math.pi))))
    return poses
