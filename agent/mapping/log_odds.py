"""The occupancy grid itself: log-odds per cell, thresholds 0.7 and 0.3, unknown between (the paper, section II).

One int8 a cell, 127 = log-odds 4: `cv2.add` saturates, which is the clamp that lets a map forget.  Each scan votes once
per cell: -0.4 where a beam passed, +0.85 where one ended.  One end makes a cell occupied only while nothing ever passed
there: where a beam did, before or after, it takes ends from two scans. A walker's single trace is no wall, and a wall
seen once is one.  The grid grows by whole tiles.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from protocol.geometry import SE2
from protocol.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

TILE_CELLS = 64  # the grid grows, and reports changes, in squares of this side
UNIT = 127 / 4.0  # cell values per unit of log-odds
HIT = 27  # +0.85: one end point makes a new cell occupied, and only just: a single pass takes it back
PASS = -13  # -0.4: three beams in a row make a new cell free, five clear a walker's single trace
NOTHING, PASSED, ENDED = 0, 1, 2
BEFORE_END_M = 0.3  # a beam that crosses a wall this far before its end should not have
SUBPIXEL_BITS = 3  # cv2 draws rays from sub-cell starts to sub-cell ends


class LogOddsGrid:
    """Growing log-odds cells, and which tiles changed when."""

    def __init__(self, resolution_m: float, occupied_above: float = 0.7, free_below: float = 0.3) -> None:
        self.resolution_m = resolution_m
        self.occupied_from = math.ceil(log_odds(occupied_above) * UNIT - 0.5)
        self.free_to = math.floor(log_odds(free_below) * UNIT + 0.5)
        self.first_tile = np.zeros(2, np.int64)  # (row, col) of cells[0, 0], in tiles from the map's origin
        self.cells = np.zeros((TILE_CELLS, TILE_CELLS), np.int8)
        self.revision = 0  # grows with every change
        self.tile_revisions = np.zeros((1, 1), np.int64)  # revision that last changed each tile

    def add(self, laser_m: tuple[float, float], points_m: NDArray[np.float64], is_hit: NDArray[np.bool_], clears: bool) -> None:
        """One scan, map frame: (N, 2) ray ends, seen from laser_m; `clears` False leaves free space alone."""
        if len(points_m) == 0:
            return
        everything = np.vstack([points_m, np.array(laser_m)])
        low = np.floor(everything.min(axis=0) / self.resolution_m).astype(np.int64) - 1  # (x, y)
        high = np.floor(everything.max(axis=0) / self.resolution_m).astype(np.int64) + 2
        self._cover(low[::-1], high[::-1])
        marks = self._marks(low, high, laser_m, points_m, is_hit, clears)
        table = np.zeros(256, np.int8)
        table[PASSED], table[ENDED] = PASS, HIT
        row, col = low[::-1] - self.first_tile * TILE_CELLS
        window = self.cells[row : row + marks.shape[0], col : col + marks.shape[1]]
        window[:] = cv2.add(window, cv2.LUT(marks, table))
        self._note_changes(row, col, marks)

    def _marks(
        self,
        low: NDArray[np.int64],
        high: NDArray[np.int64],
        laser_m: tuple[float, float],
        points_m: NDArray[np.float64],
        is_hit: NDArray[np.bool_],
        clears: bool,
    ) -> NDArray[np.uint8]:
        """What this scan says about every cell of its box; an end wins over rays that pass through the same cell."""
        marks = np.zeros((high[1] - low[1], high[0] - low[0]), np.uint8)
        ends = points_m / self.resolution_m - low  # cells, cell k covers [k, k + 1)
        if clears:
            start = np.array(laser_m) / self.resolution_m - low
            rays = np.empty((len(ends), 2, 2))
            rays[:, 0], rays[:, 1] = start, ends
            fixed = np.round((rays - 0.5) * (1 << SUBPIXEL_BITS)).astype(np.int32)  # cv2 puts pixel centres on integers
            cv2.polylines(marks, fixed, False, PASSED, shift=SUBPIXEL_BITS)  # type: ignore[call-overload]
        cells = np.floor(ends[is_hit]).astype(np.int64)
        marks[cells[:, 1], cells[:, 0]] = ENDED
        return marks

    def _cover(self, low: NDArray[np.int64], high: NDArray[np.int64]) -> None:
        """Grow to hold cells [low, high), (row, col) counted from the map's origin."""
        first = low // TILE_CELLS
        last = -(-high // TILE_CELLS)
        before = np.maximum(self.first_tile - first, 0)
        after = np.maximum(last - (self.first_tile + self.tile_revisions.shape), 0)
        if before.any() or after.any():
            tiles = ((int(before[0]), int(after[0])), (int(before[1]), int(after[1])))
            self.tile_revisions = np.pad(self.tile_revisions, tiles)
            self.cells = np.pad(self.cells, tuple((a * TILE_CELLS, b * TILE_CELLS) for a, b in tiles))
            self.first_tile = self.first_tile - before

    def _note_changes(self, row: int, col: int, marks: NDArray[np.uint8]) -> None:
        self.revision += 1
        rows = np.flatnonzero(marks.any(axis=1)) + row
        cols = np.flatnonzero(marks.any(axis=0)) + col
        self.tile_revisions[
            rows[0] // TILE_CELLS : rows[-1] // TILE_CELLS + 1, cols[0] // TILE_CELLS : cols[-1] // TILE_CELLS + 1
        ] = self.revision

    def is_free(self, points_m: NDArray[np.float64]) -> NDArray[np.bool_]:
        """(N,) whether map-frame points lie in cells known to be free."""
        return self._values(points_m) <= self.free_to

    def is_behind_wall(self, laser_m: tuple[float, float], points_m: NDArray[np.float64]) -> NDArray[np.bool_]:
        """(N,) whether the beam to a point passes an occupied cell well before it ends."""
        ray = points_m - np.array(laser_m)
        length = np.hypot(ray[:, 0], ray[:, 1])
        steps = np.arange(1, int(length.max() / self.resolution_m) + 1)[:, None] * self.resolution_m  # (S, 1) metres
        before = steps < length - BEFORE_END_M
        at, of = np.nonzero(before)
        along = np.array(laser_m) + ray[of] * (steps[at] / length[of, None])
        behind = np.zeros(len(points_m), bool)
        behind[of[self._values(along) >= self.occupied_from]] = True
        return behind

    def _values(self, points_m: NDArray[np.float64]) -> NDArray[np.int8]:
        """(N,) cell values under map-frame points; 0 outside."""
        cells = np.floor(points_m[:, ::-1] / self.resolution_m).astype(np.int64) - self.first_tile * TILE_CELLS
        inside = (cells >= 0).all(axis=1) & (cells < self.cells.shape).all(axis=1)
        values = np.zeros(len(points_m), np.int8)
        values[inside] = self.cells[cells[inside, 0], cells[inside, 1]]
        return values

    def copy(self) -> LogOddsGrid:
        twin = LogOddsGrid(self.resolution_m)
        twin.occupied_from, twin.free_to, twin.first_tile = self.occupied_from, self.free_to, self.first_tile.copy()
        twin.cells, twin.revision, twin.tile_revisions = self.cells.copy(), self.revision, self.tile_revisions.copy()
        return twin

    def replace_by(self, other: LogOddsGrid) -> None:
        """Take over the cells of another grid; only tiles whose cells differ count as changed."""
        for a, b in ((self, other), (other, self)):
            low = b.first_tile * TILE_CELLS
            a._cover(low, low + b.cells.shape)
        tiles = (self.cells != other.cells).reshape(len(self.tile_revisions), TILE_CELLS, -1, TILE_CELLS)
        self.revision += 1
        self.tile_revisions[tiles.any(axis=(1, 3))] = self.revision
        self.cells = other.cells

    def trinary(self) -> OccupancyGrid:
        """Occupied, free and unknown cells; the grid's corner lies on a tile corner of the map frame."""
        table = np.full(256, UNKNOWN, np.int8)
        values = np.arange(256).astype(np.uint8).view(np.int8)
        table[values >= self.occupied_from] = OCCUPIED
        table[values <= self.free_to] = FREE
        y, x = self.first_tile * (TILE_CELLS * self.resolution_m)
        return OccupancyGrid(cv2.LUT(self.cells.view(np.uint8), table), self.resolution_m, SE2(float(x), float(y), 0.0))


def log_odds(probability: float) -> float:
    return math.log(probability / (1.0 - probability))
