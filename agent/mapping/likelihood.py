"""One likelihood field per particle, in tiles that particles share until they differ.

The field of a particle says, for every cell, how near the closest mapped end point is: a uint8 Gaussian (255 = right
here), stamped end point by end point with `max`.  A particle is a small table of tile numbers; tiles lie in one pool and
are counted.  Resampling copies tables, and a tile is copied only when a particle writes into one it shares.

    tables[p, tile_row, tile_col] ──► pool[tile]  32 x 32 cells          tile 0 is the empty tile, never written
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

TILE = 32  # cells; 64 x 64 costs 1.5 to 2 times the memory, 16 x 16 longer tables
SHIFT = 5
AREA = TILE * TILE
RADIUS = 3  # cells: a kernel is 7 x 7
PHASES = 4  # a stamp is centred on a quarter of a cell: whole cells blur the field by half of one
EXPLAINED = (
    215  # an end point on a cell at least this bright (3.5 cm from a drawn one) is not drawn: it would only widen the wall
)
STAMPED_AT_ONCE = 2048  # end points: the first scan of 30 particles at one stroke takes 35 MB for a moment
MARGIN_TILES = 8  # tables grow by this much more than asked, so that they seldom grow

Ints = NDArray[np.int64]
Floats = NDArray[np.float32]


class TiledFields:
    """The likelihood fields of all particles."""

    def __init__(self, particles: int, resolution_m: float, sigma_m: float) -> None:
        self.resolution_m = resolution_m
        self.sigma_m = sigma_m
        self.first_tile = np.zeros(2, np.int64)  # (row, col) of tables[:, 0, 0], in tiles from the map's origin
        self.tables: Ints = np.zeros((particles, 1, 1), np.int64)
        self.pool = np.zeros((256, AREA), np.uint8)
        self.owners: Ints = np.zeros(256, np.int64)  # how many tables hold each tile
        self.kernels = stamp_kernels(sigma_m / resolution_m)

    @property
    def particles(self) -> int:
        return len(self.tables)

    def used_bytes(self) -> int:
        """Memory of tiles in use and of the tables."""
        return int(np.count_nonzero(self.owners)) * AREA + self.tables.nbytes

    def cover(self, low_m: NDArray[np.float64], high_m: NDArray[np.float64]) -> None:
        """Make the tables reach over a box (x, y), with room for kernels and interpolation."""
        side_m = TILE * self.resolution_m
        first = np.floor(low_m[::-1] / side_m).astype(np.int64) - 1
        last = np.floor(high_m[::-1] / side_m).astype(np.int64) + 1
        size = np.array(self.tables.shape[1:])
        before = self.first_tile - first
        after = last + 1 - (self.first_tile + size)
        if (before <= 0).all() and (after <= 0).all():
            return
        before = np.where(before > 0, before + MARGIN_TILES, 0)
        after = np.where(after > 0, after + MARGIN_TILES, 0)
        self.tables = np.pad(self.tables, ((0, 0), (before[0], after[0]), (before[1], after[1])))
        self.first_tile = self.first_tile - before

    def look_up(self, particles: Ints, x_m: Floats, y_m: Floats) -> tuple[Floats, Floats, Floats]:
        """Value in [0, 1] and slope along x and y (per metre) under (P, M) points, each row in its particle's field."""
        row0, row_part = self._split(y_m, 0)
        col0, col_part = self._split(x_m, 1)
        rows = np.stack([row0, row0 + 1])  # (2, P, M)
        cols = np.stack([col0, col0 + 1])
        width, area = self.tables.shape[2], self.tables.shape[1] * self.tables.shape[2]
        tile_rows = (rows >> SHIFT) * width + (particles * area)[:, None]
        places = tile_rows[:, None] + (cols >> SHIFT)[None]  # (2, 2, P, M)
        # One tile a point, those across a border mended: 37 instead of 29 us for one particle, 92 instead of 88 for 30.
        inside = ((rows & (TILE - 1)) << SHIFT)[:, None] + (cols & (TILE - 1))[None]
        tiles = self.tables.ravel().take(places, mode="clip")
        value = self.pool.ravel().take((tiles << (2 * SHIFT)) + inside, mode="clip").astype(np.float32)
        left = value[0, 0] + row_part * (value[1, 0] - value[0, 0])
        right = value[0, 1] + row_part * (value[1, 1] - value[0, 1])
        along_x = right - left
        bottom = value[0, 1] - value[0, 0]
        along_y = (value[1, 0] - value[0, 0]) + col_part * ((value[1, 1] - value[1, 0]) - bottom)
        scale = np.float32(1.0 / 255.0)
        slope = np.float32(1.0 / (255.0 * self.resolution_m))
        return (left + col_part * along_x) * scale, along_x * slope, along_y * slope

    def _split(self, along_m: Floats, axis: int) -> tuple[Ints, Floats]:
        """Cell below and fraction above it, cells counted from the table's corner, values sitting at cell centres."""
        cells = along_m * np.float32(1.0 / self.resolution_m) - np.float32(self.first_tile[axis] * TILE + 0.5)
        floor = np.floor(cells)
        return floor.astype(np.int64), cells - floor

    def stamp(self, x_m: Floats, y_m: Floats) -> None:
        """Draw (P, M) end points, row p into the field of particle p; those the field already explains change nothing."""
        row, row_phase = self._phase(y_m, 0)
        col, col_phase = self._phase(x_m, 1)
        height, width = self.tables.shape[1:]
        base = np.broadcast_to((np.arange(self.particles) * (height * width))[:, None], row.shape)
        here = self.tables.ravel().take(base + (row >> SHIFT) * width + (col >> SHIFT)) << (2 * SHIFT)
        here += ((row & (TILE - 1)) << SHIFT) + (col & (TILE - 1))
        is_new = self.pool.ravel().take(here) < EXPLAINED
        row, col, base = row[is_new], col[is_new], base[is_new]
        self._own_tiles(base, row, col)
        phase = (row_phase * PHASES + col_phase)[is_new]
        for first in range(0, len(row), STAMPED_AT_ONCE):
            some = slice(first, first + STAMPED_AT_ONCE)
            self._stamp_kernels(base[some], row[some], col[some], phase[some])

    def _stamp_kernels(self, base: Ints, row: Ints, col: Ints, phase: Ints) -> None:
        """Draw the kernels of (K,) end points into tiles that their particles own."""
        width = self.tables.shape[2]
        offsets = np.arange(-RADIUS, RADIUS + 1)
        rows = row[:, None] + offsets  # (K, 7)
        cols = col[:, None] + offsets
        places = (base[:, None] + (rows >> SHIFT) * width)[:, :, None] + (cols >> SHIFT)[:, None, :]
        cells = self.tables.ravel().take(places) << (2 * SHIFT)
        cells += ((rows & (TILE - 1)) << SHIFT)[:, :, None] + (cols & (TILE - 1))[:, None, :]
        values = self.kernels.take(phase, axis=0)
        put_max(self.pool.ravel(), cells.ravel(), values.ravel())

    def _phase(self, along_m: Floats, axis: int) -> tuple[Ints, Ints]:
        """Cell that holds a coordinate, counted from the table's corner, and the quarter of it."""
        quarters = np.floor(along_m * np.float32(PHASES / self.resolution_m)).astype(np.int64)
        quarters -= self.first_tile[axis] * (TILE * PHASES)
        return quarters // PHASES, quarters % PHASES

    def _own_tiles(self, base: Ints, row: Ints, col: Ints) -> None:
        """Give every particle tiles of its own wherever it is about to write."""
        touched = np.zeros(self.tables.size, bool)
        width = self.tables.shape[2]
        for tile_row in ((row - RADIUS) >> SHIFT, (row + RADIUS) >> SHIFT):
            for tile_col in ((col - RADIUS) >> SHIFT, (col + RADIUS) >> SHIFT):
                touched[base + tile_row * width + tile_col] = True
        places = np.flatnonzero(touched)
        table = self.tables.ravel()
        held = table[places]
        shared = (held == 0) | (self.owners[held] > 1)
        places, held = places[shared], held[shared]
        fresh = self._unused_tiles(len(places))
        self.pool[fresh] = self.pool[held]
        self.owners[fresh] = 1
        np.subtract.at(self.owners, held[held > 0], 1)
        table[places] = fresh

    def _unused_tiles(self, n: int) -> Ints:
        unused = np.flatnonzero(self.owners[1:] == 0) + 1
        if len(unused) < n:
            grown = np.zeros((max(3 * len(self.pool) // 2, len(self.pool) + n), AREA), np.uint8)  # no memory until written
            grown[: len(self.pool)] = self.pool
            self.owners = np.append(self.owners, np.zeros(len(grown) - len(self.pool), np.int64))
            self.pool = grown
            unused = np.flatnonzero(self.owners[1:] == 0) + 1
        return unused[:n]

    def put(self, tables: Ints, tiles: NDArray[np.uint8], first_tile: Ints) -> None:
        """Take over stored tables and tiles."""
        self.tables, self.pool, self.first_tile = tables, tiles, first_tile
        self._count_owners()

    def resample(self, ancestors: Ints) -> None:
        """Particle i becomes a copy of particle ancestors[i]: tables are copied, tiles are shared."""
        self.tables = np.ascontiguousarray(self.tables[ancestors])
        self._count_owners()

    def _count_owners(self) -> None:
        self.owners = np.bincount(self.tables.ravel(), minlength=len(self.pool)).astype(np.int64)
        self.owners[0] = 0


def put_max(target: NDArray[np.uint8], places: Ints, values: NDArray[np.uint8]) -> None:
    """target[places] = max(target[places], values) where places may repeat (np.maximum.at took 4 times as long)."""
    while True:
        higher = np.flatnonzero(values > target.take(places))
        if len(higher) == 0:
            return
        places, values = places[higher], values[higher]
        target[places] = values


def stamp_kernels(sigma_cells: float) -> NDArray[np.uint8]:
    """(16, 7, 7) Gaussians centred on each quarter-cell phase, rows first; peak 255 on the phase itself."""
    centres = (np.arange(PHASES) + 0.5) / PHASES - 0.5
    offsets = np.arange(-RADIUS, RADIUS + 1)
    profile = np.exp(-0.5 * ((offsets[None, :] - centres[:, None]) / sigma_cells) ** 2)  # (4, 7)
    kernels = 255.0 * profile[:, None, :, None] * profile[None, :, None, :]
    return np.ascontiguousarray(np.round(kernels).astype(np.uint8).reshape(PHASES * PHASES, 2 * RADIUS + 1, 2 * RADIUS + 1))
