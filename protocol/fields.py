"""The strict readers and writers of single fields, out of which `schemas.SCHEMAS` builds every message.

A field kind turns a value into something msgpack knows and back.  Reading trusts nothing: type, range, length and
finiteness are checked before anything is allocated, and the only error is `RemoteProtocolError`.  Feature tables and grids
are in `map_fields.py`.
"""

from __future__ import annotations

import enum
import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from protocol.errors import RemoteProtocolError, TooLarge
from protocol.geometry import SE2, wrap_angle
from protocol.names import is_robot_id

MAX_COORDINATE_M = 1e6


@dataclass(frozen=True, slots=True)
class Kind:
    """How one sort of value becomes plain msgpack data, and how plain data is believed."""

    pack: Callable[[Any], Any]
    read: Callable[[Any], Any]  # raises RemoteProtocolError


def refuse(what: str, value: object) -> RemoteProtocolError:
    """The error that says what was expected and what came."""
    return RemoteProtocolError(f"{what}, not {str(value)[:40]!r}")


def uint(limit: int) -> Kind:
    """A whole number in [0, limit]."""

    def read(value: Any) -> int:
        if type(value) is not int or not 0 <= value <= limit:
            raise refuse(f"a whole number up to {limit}", value)
        return value

    return Kind(int, read)


def real(low: float, high: float) -> Kind:
    """A finite number in [low, high]."""

    def read(value: Any) -> float:
        if type(value) not in (float, int) or not low <= value <= high:  # NaN fails every comparison
            raise refuse(f"a number in [{low}, {high}]", value)
        return float(value) + 0.0  # -0.0 becomes 0.0: equal values are equal bytes

    return Kind(float, read)


def text(limit: int) -> Kind:
    """Printable text of at most `limit` characters: what goes to logs and screens carries no escapes."""

    def read(value: Any) -> str:
        if type(value) is not str or len(value) > limit or not value.isprintable():
            raise refuse(f"printable text up to {limit} characters", type(value).__name__)
        return value

    return Kind(str, read)


def blob(low: int, high: int) -> Kind:
    """Between low and high raw bytes."""

    def read(value: Any) -> bytes:
        if type(value) is not bytes or not low <= len(value) <= high:
            raise refuse(f"{low} to {high} bytes", type(value).__name__)
        return value

    return Kind(bytes, read)


def digest(size: int, *, is_optional: bool = False) -> Kind:
    """Exactly `size` bytes; or none at all, where allowed."""
    inner = blob(0 if is_optional else size, size)

    def read(value: Any) -> bytes:
        data: bytes = inner.read(value)
        if len(data) not in (0, size):
            raise refuse(f"a digest of {size} bytes", len(data))
        return data

    return Kind(bytes, read)


def _read_name(value: Any) -> str:
    if type(value) is not str or not is_robot_id(value):
        raise refuse("a robot id", value)
    return value


def _read_flag(value: Any) -> bool:
    if type(value) is not bool:
        raise refuse("true or false", value)
    return value


def _pack_se2(T: SE2) -> bytes:
    return struct.pack("<3d", T.x_m, T.y_m, T.theta_rad)


def _read_se2(value: Any) -> SE2:
    x_m, y_m, theta_rad = _read_doubles(value, 3)
    if max(abs(x_m), abs(y_m)) > MAX_COORDINATE_M or abs(theta_rad) > 1e6:
        raise refuse("a transform near the origin", (x_m, y_m, theta_rad))
    return SE2(x_m + 0.0, y_m + 0.0, wrap_angle(theta_rad) + 0.0)


def _read_covariance(value: Any) -> tuple[float, ...]:
    """A symmetric 3x3 matrix as its upper triangle; positive semi-definite, up to rounding."""
    xx, xy, xt, yy, yt, tt = entries = _read_doubles(value, 6)
    if max(abs(entry) for entry in entries) > 1e12 or min(xx, yy, tt) < 0:
        raise refuse("a covariance", entries)
    slack = 1.0 + 1e-6
    if xy * xy > xx * yy * slack or xt * xt > xx * tt * slack or yt * yt > yy * tt * slack:
        raise refuse("a covariance", entries)
    return entries


def _read_doubles(value: Any, count: int) -> tuple[float, ...]:
    if type(value) is not bytes or len(value) != 8 * count:
        raise refuse(f"{count} packed numbers", type(value).__name__)
    numbers = struct.unpack(f"<{count}d", value)
    if not all(math.isfinite(number) for number in numbers):
        raise refuse("finite numbers", numbers)
    return numbers


NAME = Kind(str, _read_name)
FLAG = Kind(bool, _read_flag)
TRANSFORM = Kind(_pack_se2, _read_se2)
RESOLUTION = real(0.001, 10.0)
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
            raise refuse("a list", type(value).__name__)
        if len(value) > limit:
            raise TooLarge(f"a list of {len(value)}; at most {limit} are allowed")
        return tuple(kind.read(item) for item in value)

    return Kind(lambda values: [kind.pack(value) for value in values], read)


def one_of(choices: type[enum.Enum]) -> Kind:
    by_value = {choice.value: choice for choice in choices}

    def read(value: Any) -> Any:
        if type(value) is not str or value not in by_value:
            raise refuse(f"one of {', '.join(map(str, by_value))}", value)
        return by_value[value]

    return Kind(lambda choice: choice.value, read)
