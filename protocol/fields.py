"""The strict readers and writers of single fields, out of which `schemas.SCHEMAS` builds every message.

A field kind turns a value into something msgpack knows and back.  Reading trusts nothing: type, range, length and
finiteness are checked before anything is allocated, and the only error is `RemoteProtocolError`.
"""

from __future__ import annotations

import enum
import itertools
import math
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol import features as f
from protocol.errors import RemoteProtocolError, TooLarge
from protocol.geometry import SE2, wrap_angle
from protocol.grid import OccupancyGrid
from protocol.messages import is_robot_id
from protocol.tiles import MAX_TILE_INDEX, MAX_TILES, TileKey, inflate, pack_cells, unpack_cells

MAX_COORDINATE_M = 1e6
MAX_ROWS = 20_000  # of one kind of feature


@dataclass(frozen=True, slots=True)
class Kind:
    """How one sort of value becomes plain msgpack data, and how plain data is believed."""

    pack: Callable[[Any], Any]
    read: Callable[[Any], Any]  # raises RemoteProtocolError


def _refuse(what: str, value: object) -> RemoteProtocolError:
    return RemoteProtocolError(f"{what}, not {str(value)[:40]!r}")


def uint(limit: int) -> Kind:
    """A whole number in [0, limit]."""

    def read(value: Any) -> int:
        if type(value) is not int or not 0 <= value <= limit:
            raise _refuse(f"a whole number up to {limit}", value)
        return value

    return Kind(int, read)


def real(low: float, high: float) -> Kind:
    """A finite number in [low, high]."""

    def read(value: Any) -> float:
        if type(value) not in (float, int) or not low <= value <= high:  # NaN fails every comparison
            raise _refuse(f"a number in [{low}, {high}]", value)
        return float(value) + 0.0  # -0.0 becomes 0.0: equal values are equal bytes

    return Kind(float, read)


def text(limit: int) -> Kind:
    """Printable text of at most `limit` characters: what goes to logs and screens carries no escapes."""

    def read(value: Any) -> str:
        if type(value) is not str or len(value) > limit or not value.isprintable():
            raise _refuse(f"printable text up to {limit} characters", type(value).__name__)
        return value

    return Kind(str, read)


def blob(low: int, high: int) -> Kind:
    """Between low and high raw bytes."""

    def read(value: Any) -> bytes:
        if type(value) is not bytes or not low <= len(value) <= high:
            raise _refuse(f"{low} to {high} bytes", type(value).__name__)
        return value

    return Kind(bytes, read)


def digest(size: int, *, is_optional: bool = False) -> Kind:
    """Exactly `size` bytes; or none at all, where allowed."""
    inner = blob(0 if is_optional else size, size)

    def read(value: Any) -> bytes:
        data: bytes = inner.read(value)
        if len(data) not in (0, size):
            raise _refuse(f"a digest of {size} bytes", len(data))
        return data

    return Kind(bytes, read)


def _read_name(value: Any) -> str:
    if type(value) is not str or not is_robot_id(value):
        raise _refuse("a robot id", value)
    return value


def _read_flag(value: Any) -> bool:
    if type(value) is not bool:
        raise _refuse("true or false", value)
    return value


def _pack_se2(T: SE2) -> bytes:
    return struct.pack("<3d", T.x_m, T.y_m, T.theta_rad)


def _read_se2(value: Any) -> SE2:
    x_m, y_m, theta_rad = _read_doubles(value, 3)
    if max(abs(x_m), abs(y_m)) > MAX_COORDINATE_M or abs(theta_rad) > 1e6:
        raise _refuse("a transform near the origin", (x_m, y_m, theta_rad))
    return SE2(x_m + 0.0, y_m + 0.0, wrap_angle(theta_rad) + 0.0)


def _read_covariance(value: Any) -> tuple[float, ...]:
    """A symmetric 3x3 matrix as its upper triangle; positive semi-definite, up to rounding."""
    xx, xy, xt, yy, yt, tt = entries = _read_doubles(value, 6)
    if max(abs(entry) for entry in entries) > 1e12 or min(xx, yy, tt) < 0:
        raise _refuse("a covariance", entries)
    slack = 1.0 + 1e-6
    if xy * xy > xx * yy * slack or xt * xt > xx * tt * slack or yt * yt > yy * tt * slack:
        raise _refuse("a covariance", entries)
    return entries


def _read_doubles(value: Any, count: int) -> tuple[float, ...]:
    if type(value) is not bytes or len(value) != 8 * count:
        raise _refuse(f"{count} packed numbers", type(value).__name__)
    numbers = struct.unpack(f"<{count}d", value)
    if not all(math.isfinite(number) for number in numbers):
        raise _refuse("finite numbers", numbers)
    return numbers


NAME = Kind(str, _read_name)
FLAG = Kind(bool, _read_flag)
TRANSFORM = Kind(_pack_se2, _read_se2)
COVARIANCE = Kind(lambda entries: struct.pack("<6d", *entries), _read_covariance)


def optional(kind: Kind) -> Kind:
    """The value or None."""
    return Kind(
        lambda value: None if value is None else kind.pack(value),
        lambda value: None if value is None else kind.read(value),
    )


def list_of(kind: Kind, limit: int) -> Kind:
    """A tuple of at most `limit` values."""

    def read(value: Any) -> tuple[Any, ...]:
        if type(value) is not list:
            raise _refuse("a list", type(value).__name__)
        if len(value) > limit:
            raise TooLarge(f"a list of {len(value)}; at most {limit} are allowed")
        return tuple(kind.read(item) for item in value)

    return Kind(lambda values: [kind.pack(value) for value in values], read)


def one_of(choices: type[enum.Enum]) -> Kind:
    by_value = {choice.value: choice for choice in choices}

    def read(value: Any) -> Any:
        if type(value) is not str or value not in by_value:
            raise _refuse(f"one of {', '.join(map(str, by_value))}", value)
        return by_value[value]

    return Kind(lambda choice: choice.value, read)


# A feature table travels column by column as whole numbers of a quantum, bytes of equal weight together, deflated: a third
# of float32.  The quanta are far below what any feature is known to.
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
        raise _refuse("a feature map", type(value).__name__)
    rows = _READ_ROWS.read(value[0])
    if len(rows) != len(_TABLES):
        raise _refuse(f"{len(_TABLES)} kinds of features", len(rows))
    sizes = [n * sum(np.dtype(dtype).itemsize for dtype, _ in kinds) for n, (_, _, kinds) in zip(rows, _TABLES, strict=True)]
    plain, at, tables = inflate(value[1], sum(sizes)), 0, {}
    for n, size, (name, _, kinds) in zip(rows, sizes, _TABLES, strict=True):
        tables[name] = _read_table(plain[at : at + size], n, kinds)
        at += size
    return f.FeatureMap(**tables)


def _pack_grid(grid: OccupancyGrid) -> list[Any]:
    return [grid.height, grid.width, float(grid.resolution_m), _pack_se2(grid.origin), pack_cells(grid.cells)]


_RESOLUTION = real(0.001, 10.0)
_SIDE = uint(2**16)


def _read_grid(value: Any) -> OccupancyGrid:
    if type(value) is not list or len(value) != 5 or type(value[4]) is not bytes:
        raise _refuse("a grid", type(value).__name__)
    height, width, resolution_m = _SIDE.read(value[0]), _SIDE.read(value[1]), _RESOLUTION.read(value[2])
    origin = _read_se2(value[3])
    return OccupancyGrid(unpack_cells(value[4], height, width), resolution_m, origin)


def _pack_tile_keys(keys: tuple[TileKey, ...]) -> bytes:
    return np.array(keys, "<i2").reshape(-1, 2).tobytes()


def _read_tile_keys(value: Any) -> tuple[TileKey, ...]:
    if type(value) is not bytes or len(value) % 4:
        raise _refuse("tile indices", type(value).__name__)
    if len(value) > 4 * MAX_TILES:
        raise TooLarge(f"{len(value) // 4} tiles; {MAX_TILES} are allowed")
    keys = [(int(row), int(col)) for row, col in np.frombuffer(value, "<i2").reshape(-1, 2)]
    if any(a >= b for a, b in itertools.pairwise(keys)):
        raise _refuse("tile indices in order, each once", len(keys))
    if any(max(abs(row), abs(col)) > MAX_TILE_INDEX for row, col in keys):
        raise _refuse("tile indices within the lattice", len(keys))
    return tuple(keys)


FEATURES = Kind(_pack_features, _read_features)
GRID = Kind(_pack_grid, _read_grid)
TILE_KEYS = Kind(_pack_tile_keys, _read_tile_keys)
RESOLUTION = _RESOLUTION
