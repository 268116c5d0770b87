"""How the large parts of a message travel: feature tables, grids, and the names of tiles.

A feature table travels column by column as whole numbers of a quantum, bytes of equal weight together, deflated: a third of
float32.  The quanta are far below what any feature is known to.
"""

from __future__ import annotations

import itertools
import math
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol import features as f
from protocol.errors import TooLarge
from protocol.fields import RESOLUTION, TRANSFORM, Kind, list_of, refuse, uint
from protocol.grid import OccupancyGrid
from protocol.tiles import MAX_TILE_INDEX, MAX_TILES, TileKey, inflate, pack_cells, unpack_cells

MAX_ROWS = 20_000  # of one kind of feature

_LENGTH = ("<u2", 0.01)
_ANGLE = ("<u2", math.tau / 65_536)
_PLACE = ("<i4", 0.005)
_SIGMA_M = ("<u2", 0.0005)
_SIGMA_RAD = ("<u2", 0.0001)
_TABLES: tuple[tuple[str, tuple[str, ...], tuple[tuple[str, float], ...]], ...] = (
    ("lines", f.LINE_COLUMNS, (_PLACE, _PLACE, _ANGLE, _LENGTH, _SIGMA_RAD, _SIGMA_M)),
    ("circles", f.CIRCLE_COLUMNS, (_PLACE, _PLACE, _LENGTH, _SIGMA_M)),
    ("arcs", f.ARC_COLUMNS, (_PLACE, _PLACE, _LENGTH, _ANGLE, _ANGLE, _SIGMA_M)),
    ("curves", f.CURVE_COLUMNS, (_PLACE, _PLACE, _ANGLE, _LENGTH, _SIGMA_M)),
)


def _pack_table(table: NDArray[np.float32], columns: tuple[tuple[str, float], ...]) -> bytes:
    parts = []
    for i, (dtype, quantum) in enumerate(columns):
        steps = np.rint(table[:, i].astype(np.float64) / quantum)
        limits = np.iinfo(dtype)
        wrapped = steps % 65_536 if (dtype, quantum) == _ANGLE else np.clip(np.nan_to_num(steps), limits.min, limits.max)
        parts.append(wrapped.astype(dtype).view(np.uint8).reshape(len(table), np.dtype(dtype).itemsize).T.tobytes())
    return b"".join(parts)


def _read_table(data: bytes, rows: int, columns: tuple[tuple[str, float], ...]) -> NDArray[np.float32]:
    table, at = np.zeros((rows, len(columns)), np.float32), 0
    for i, (dtype, quantum) in enumerate(columns):
        size = np.dtype(dtype).itemsize
        planes = np.frombuffer(data, np.uint8, rows * size, at).reshape(size, rows)
        steps = np.ascontiguousarray(planes.T).view(dtype).reshape(rows).astype(np.float64)
        values = steps * quantum
        table[:, i] = (values + math.pi) % math.tau - math.pi if (dtype, quantum) == _ANGLE else values
        at += rows * size
    return table


def _pack_features(features: f.FeatureMap) -> list[Any]:
    tables = [getattr(features, name)[:MAX_ROWS] for name, _, _ in _TABLES]
    plain = b"".join(_pack_table(table, kinds) for table, (_, _, kinds) in zip(tables, _TABLES, strict=True))
    return [[len(table) for table in tables], zlib.compress(plain, 9)]


_READ_ROWS = list_of(uint(MAX_ROWS), len(_TABLES))


def _read_features(value: Any) -> f.FeatureMap:
    if type(value) is not list or len(value) != 2 or type(value[1]) is not bytes:
        raise refuse("a feature map", type(value).__name__)
    rows = _READ_ROWS.read(value[0])
    if len(rows) != len(_TABLES):
        raise refuse(f"{len(_TABLES)} kinds of features", len(rows))
    sizes = [n * sum(np.dtype(dtype).itemsize for dtype, _ in kinds) for n, (_, _, kinds) in zip(rows, _TABLES, strict=True)]
    plain, at, tables = inflate(value[1], sum(sizes)), 0, {}
    for n, size, (name, _, kinds) in zip(rows, sizes, _TABLES, strict=True):
        tables[name] = _read_table(plain[at : at + size], n, kinds)
        at += size
    return f.FeatureMap(**tables)


def _pack_grid(grid: OccupancyGrid) -> list[Any]:
    return [grid.height, grid.width, float(grid.resolution_m), TRANSFORM.pack(grid.origin), pack_cells(grid.cells)]


_SIDE = uint(2**16)


def _read_grid(value: Any) -> OccupancyGrid:
    if type(value) is not list or len(value) != 5 or type(value[4]) is not bytes:
        raise refuse("a grid", type(value).__name__)
    height, width, resolution_m = _SIDE.read(value[0]), _SIDE.read(value[1]), RESOLUTION.read(value[2])
    origin = TRANSFORM.read(value[3])
    return OccupancyGrid(unpack_cells(value[4], height, width), resolution_m, origin)


def _pack_tile_keys(keys: tuple[TileKey, ...]) -> bytes:
    return np.array(keys, "<i2").reshape(-1, 2).tobytes()


def _read_tile_keys(value: Any) -> tuple[TileKey, ...]:
    if type(value) is not bytes or len(value) % 4:
        raise refuse("tile indices", type(value).__name__)
    if len(value) > 4 * MAX_TILES:
        raise TooLarge(f"{len(value) // 4} tiles; {MAX_TILES} are allowed")
    keys = [(int(row), int(col)) for row, col in np.frombuffer(value, "<i2").reshape(-1, 2)]
    if any(a >= b for a, b in itertools.pairwise(keys)):
        raise refuse("tile indices in order, each once", len(keys))
    if any(max(abs(row), abs(col)) > MAX_TILE_INDEX for row, col in keys):
        raise refuse("tile indices within the lattice", len(keys))
    return tuple(keys)


FEATURES = Kind(_pack_features, _read_features)
GRID = Kind(_pack_grid, _read_grid)
TILE_KEYS = Kind(_pack_tile_keys, _read_tile_keys)
