"""Every message's fields: their short keys on the wire, how each is written and believed, and what stands for one left out.

A key that is not in the table is ignored and a field with a default may be left out, so fields can be added within a version.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from protocol import messages as m
from protocol.channels import CHUNK_BYTES, MAX_ANSWER_BYTES
from protocol.errors import RemoteProtocolError
from protocol.fields import (
    COVARIANCE,
    FLAG,
    NAME,
    RESOLUTION,
    TRANSFORM,
    Kind,
    blob,
    digest,
    list_of,
    one_of,
    optional,
    real,
    text,
    uint,
)
from protocol.map_fields import FEATURES, GRID, TILE_KEYS
from protocol.tiles import TileDelta

_REQUIRED = object()
_U16, _U32, _U64 = uint(2**16 - 1), uint(2**32 - 1), uint(2**64 - 1)
_SECONDS = real(0.0, 1e10)
_AREA = real(0.0, 1e9)
_CELLS = uint(2**40)


@dataclass(frozen=True, slots=True)
class Field:
    """One attribute of a message, its short key on the wire, and what it stands for when a peer leaves it out."""

    name: str
    key: str
    kind: Kind
    default: Any = _REQUIRED


def plain(value: Any) -> dict[str, Any]:
    """Short key -> plain value, for a message or a part of one; what is as by default stays unsaid."""
    said = {}
    for field in SCHEMAS[type(value)]:
        content = getattr(value, field.name)
        if field.default is _REQUIRED or content != field.default:
            said[field.key] = field.kind.pack(content)
    return said


def believe(said: Any, kind: type) -> Any:
    """The message, or the part of one, that plain data says; every field checked, unknown keys ignored."""
    if type(said) is not dict:
        raise RemoteProtocolError(f"{kind.__name__}: a map is expected, not {type(said).__name__}")
    values = {}
    for field in SCHEMAS[kind]:
        if field.key in said:
            try:
                values[field.name] = field.kind.read(said[field.key])
            except RemoteProtocolError as error:
                raise type(error)(f"{kind.__name__}.{field.name}: {error}") from None
        elif field.default is _REQUIRED:
            raise RemoteProtocolError(f"{kind.__name__}.{field.name} is missing")
        else:
            values[field.name] = field.default
    return kind(**values)


def _nested(kind: type) -> Kind:
    """A message part with a schema of its own."""
    return Kind(plain, lambda said: believe(said, kind))


_MAP = _nested(m.MapVersion)
_HEAD = (Field("robot", "r", NAME), Field("boot", "b", _U64))

SCHEMAS: dict[type, tuple[Field, ...]] = {
    m.MapVersion: (Field("frame", "f", _U64), Field("revision", "n", _U32), Field("digest", "d", digest(16))),
    m.Hello: (
        *_HEAD,
        Field("uptime_s", "u", _SECONDS),
        Field("protocol_min", "p", _U16),
        Field("protocol_max", "P", _U16),
        Field("software", "s", text(64)),
        Field("resolution_m", "R", RESOLUTION),
        Field("is_frozen", "F", FLAG, False),
        Field("locators", "l", list_of(text(128), 8), ()),
    ),
    m.Beat: (
        *_HEAD,
        Field("seq", "s", _U64),
        Field("uptime_s", "u", _SECONDS),
        Field("period_s", "p", real(0.01, 600.0)),
        Field("map", "m", optional(_MAP)),
        Field("edges_digest", "e", digest(8, is_optional=True)),
        Field("global_digest", "g", digest(16, is_optional=True)),
        Field("T_map_robot", "T", optional(TRANSFORM), None),
        Field("is_frozen", "F", FLAG, False),
        Field("load", "L", real(0.0, 1.0), 0.0),
        Field("known_area_m2", "a", _AREA, 0.0),
    ),
    m.MapAnnouncement: (
        *_HEAD,
        Field("map", "m", _MAP),
        Field("resolution_m", "R", RESOLUTION),
        Field("known_area_m2", "a", _AREA),
        Field("fine_bytes", "n", _U32),
        Field("features", "f", FEATURES),
        Field("is_frozen", "F", FLAG, False),
    ),
    m.CoarseMap: (*_HEAD, Field("map", "m", _MAP), Field("grid", "g", GRID)),
    TileDelta: (
        Field("base_digest", "B", digest(16, is_optional=True)),
        Field("digest", "D", digest(16)),
        Field("resolution_m", "R", RESOLUTION),
        Field("anchor", "A", TRANSFORM),
        Field("keys", "k", TILE_KEYS),
        Field("payload", "z", blob(0, MAX_ANSWER_BYTES)),
    ),
    m.FineTiles: (*_HEAD, Field("map", "m", _MAP), Field("delta", "d", _nested(TileDelta))),
    m.Evidence: (
        Field("robot_a", "ra", NAME),
        Field("robot_b", "rb", NAME),
        Field("map_a", "ma", _MAP),
        Field("map_b", "mb", _MAP),
        Field("proposer", "p", NAME),
        Field("T_a_b", "T", TRANSFORM),
        Field("covariance", "c", COVARIANCE),
        Field("agree", "y", _CELLS),
        Field("disagree", "n", _CELLS),
        Field("overlap_m2", "o", _AREA),
        Field("score", "s", real(-1e9, 1e9)),
    ),
    m.Statement: (
        *_HEAD,
        Field("seq", "s", _U64),
        Field("other", "o", NAME),
        Field("stance", "S", one_of(m.Stance)),
        Field("evidence", "e", _nested(m.Evidence)),
        Field("holds", "h", digest(8, is_optional=True), b""),
        Field("reason", "w", text(80), ""),
    ),
    m.Statements: (*_HEAD, Field("seq", "s", _U64), Field("statements", "S", list_of(_nested(m.Statement), 1_024))),
    m.GlobalMember: (
        Field("robot", "r", NAME),
        Field("map", "m", _MAP),
        Field("T_global_map", "T", TRANSFORM),
        Field("covariance", "c", COVARIANCE),
    ),
    m.GlobalMeta: (
        *_HEAD,
        Field("seq", "s", _U64),
        Field("root", "o", NAME),
        Field("resolution_m", "R", RESOLUTION),
        Field("members", "m", list_of(_nested(m.GlobalMember), 1_024)),
        Field("edges", "e", list_of(digest(8), 8_192)),
        Field("digest", "d", digest(16)),
        Field("conflicting_cells", "x", _CELLS),
        Field("agreeing_cells", "y", _CELLS),
    ),
    m.GlobalTiles: (*_HEAD, Field("delta", "d", _nested(TileDelta))),
    m.Estate: (
        *_HEAD,
        Field("gone", "o", NAME),
        Field("gone_boot", "O", _U64),
        Field("is_frozen", "F", FLAG, False),
        Field("statements", "S", list_of(_nested(m.Statement), 1_024)),
        Field("map", "m", _MAP),
        Field("delta", "d", _nested(TileDelta)),
    ),
    m.Manifest: (
        *_HEAD,
        Field("digest", "d", digest(32)),
        Field("size_bytes", "n", uint(MAX_ANSWER_BYTES)),
        Field("chunk_bytes", "c", uint(CHUNK_BYTES)),
    ),
    m.Chunk: (*_HEAD, Field("digest", "d", digest(32)), Field("index", "i", _U16), Field("data", "z", blob(1, CHUNK_BYTES))),
}
