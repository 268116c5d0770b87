"""Messages to bytes and back.  `decode` returns a message or raises `RemoteProtocolError`: nothing else, whatever the bytes.

    0      2       3      4          8
    | "MQ" | major | kind | crc32 LE | msgpack map {short key: plain value} ...

The checksum covers the two bytes before it and everything behind it.  Unknown map keys are ignored, so fields can be
added; an unknown kind or a higher major version is told apart from damage.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import Any

import msgpack

from protocol import messages as m
from protocol.channels import BY_KIND, BY_NUMBER, CHUNK_BYTES, MAJOR_VERSION, MAX_ANSWER_BYTES, MAX_MESSAGE_BYTES
from protocol.errors import LocalProtocolError, NewerPeer, RemoteProtocolError, TooLarge
from protocol.fields import (
    COVARIANCE,
    FEATURES,
    FLAG,
    GRID,
    NAME,
    RESOLUTION,
    TILE_KEYS,
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
from protocol.tiles import TileDelta

MAGIC = b"MQ"
HEADER_BYTES = 8
_MAX_TEXT_BYTES = 1_024  # of any one string
_CHECKED_BYTES = 2_048  # what we say is read back when it is small: that costs microseconds and finds our own mistakes

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


def _nested(kind: type) -> Kind:
    """A message part with a schema of its own."""
    return Kind(lambda value: _plain(value, SCHEMAS[kind]), lambda value: _believe(value, kind))


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
    m.Manifest: (
        *_HEAD,
        Field("digest", "d", digest(32)),
        Field("size_bytes", "n", uint(MAX_ANSWER_BYTES)),
        Field("chunk_bytes", "c", uint(CHUNK_BYTES)),
    ),
    m.Chunk: (*_HEAD, Field("digest", "d", digest(32)), Field("index", "i", _U16), Field("data", "z", blob(1, CHUNK_BYTES))),
}


def encode(message: m.Message) -> bytes:
    """The bytes of a message; a `LocalProtocolError` when we try to say what no peer would believe."""
    channel = BY_KIND[type(message)]
    body = bytes(msgpack.packb(_plain(message, SCHEMAS[type(message)]), use_bin_type=True))
    head = bytes((MAJOR_VERSION, channel.number))
    data = MAGIC + head + zlib.crc32(body, zlib.crc32(head)).to_bytes(4, "little") + body
    if len(data) > channel.max_bytes:
        raise LocalProtocolError(f"{channel.name}: {len(data)} bytes; at most {channel.max_bytes} may travel")
    if len(data) <= _CHECKED_BYTES:
        try:
            decode(data)
        except RemoteProtocolError as error:
            raise LocalProtocolError(f"{channel.name}: no peer would believe this: {error}") from None
    return data


def decode(data: bytes) -> m.Message:
    """The message in these bytes, every field checked."""
    number = _opened(data)
    channel = BY_NUMBER.get(number)
    if channel is None:
        raise RemoteProtocolError(f"message kind {number} is not known here")
    if len(data) > channel.max_bytes:
        raise TooLarge(f"{channel.name}: {len(data)} bytes; {channel.max_bytes} are allowed")
    message: m.Message = _believe(_unpacked(data[HEADER_BYTES:], channel.max_items), channel.kind)
    _check_sense(message)
    return message


def encode_versions(lowest: int, highest: int) -> bytes:
    """What is published on `channels.version_key`: four bytes, the same in every version for ever."""
    return MAGIC + bytes((lowest, highest))


def decode_versions(data: bytes) -> tuple[int, int]:
    if len(data) < 4 or data[:2] != MAGIC or data[2] > data[3]:
        raise RemoteProtocolError(f"no version range in {data[:8].hex()}")
    return data[2], data[3]


def _opened(data: bytes) -> int:
    """Check the envelope; the number of the kind inside."""
    if len(data) < HEADER_BYTES or data[:2] != MAGIC:
        raise RemoteProtocolError(f"{len(data)} bytes that begin with {data[:4].hex() or 'nothing'}: no message")
    if len(data) > MAX_MESSAGE_BYTES:
        raise TooLarge(f"a message of {len(data)} bytes; {MAX_MESSAGE_BYTES} are allowed")
    if data[2] > MAJOR_VERSION:
        raise NewerPeer(f"a message of protocol version {data[2]}; this program speaks {MAJOR_VERSION}: update it")
    if data[2] != MAJOR_VERSION:
        raise RemoteProtocolError(f"a message of protocol version {data[2]}; this program speaks {MAJOR_VERSION}")
    if zlib.crc32(data[HEADER_BYTES:], zlib.crc32(data[2:4])) != int.from_bytes(data[4:8], "little"):
        raise RemoteProtocolError("checksum does not fit")
    return data[3]


def _unpacked(body: bytes, max_items: int) -> Any:
    """Plain msgpack data; nothing is allocated beyond what the bytes themselves hold and the channel allows."""
    containers = 0

    def count(container: Any) -> Any:
        nonlocal containers
        containers += 1
        if containers > max_items:
            raise ValueError("too many lists and maps")
        return container

    cap = min(len(body), max_items)
    try:
        return msgpack.unpackb(
            body,
            raw=False,
            strict_map_key=True,
            list_hook=count,
            object_hook=count,
            max_str_len=min(len(body), _MAX_TEXT_BYTES),
            max_bin_len=len(body),
            max_array_len=cap,
            max_map_len=cap,
            max_ext_len=0,
        )
    except (ValueError, TypeError, OverflowError, RecursionError, msgpack.UnpackException) as error:
        raise RemoteProtocolError(f"no msgpack data: {type(error).__name__}") from None


def _plain(value: Any, schema: tuple[Field, ...]) -> dict[str, Any]:
    plain = {}
    for field in schema:
        content = getattr(value, field.name)
        if field.default is _REQUIRED or content != field.default:
            plain[field.key] = field.kind.pack(content)
    return plain


def _believe(plain: Any, kind: type) -> Any:
    if type(plain) is not dict:
        raise RemoteProtocolError(f"{kind.__name__}: a map is expected, not {type(plain).__name__}")
    values = {}
    for field in SCHEMAS[kind]:
        if field.key in plain:
            try:
                values[field.name] = field.kind.read(plain[field.key])
            except RemoteProtocolError as error:
                raise type(error)(f"{kind.__name__}.{field.name}: {error}") from None
        elif field.default is _REQUIRED:
            raise RemoteProtocolError(f"{kind.__name__}.{field.name} is missing")
        else:
            values[field.name] = field.default
    return kind(**values)


def _check_sense(message: m.Message) -> None:
    """What single fields cannot see: parts that contradict one another."""
    match message:
        case m.Statement():
            _check_statement(message)
        case m.Statements():
            for statement in message.statements:
                if (statement.robot, statement.boot) != (message.robot, message.boot):
                    raise RemoteProtocolError(f"statements of {message.robot} hold one of {statement.robot}")
                _check_statement(statement)
        case m.FineTiles() if message.map.digest != message.delta.digest:
            raise RemoteProtocolError("fine tiles do not lead to the map they announce")
        case m.GlobalMeta():
            names = [member.robot for member in message.members]
            if names != sorted(set(names)) or message.root not in names:
                raise RemoteProtocolError("members of a global map: each once, in order, the root among them")
        case m.Hello() if message.protocol_min > message.protocol_max:
            raise RemoteProtocolError("hello: an empty range of protocol versions")
        case m.Manifest() if not 0 < message.chunk_bytes <= CHUNK_BYTES or message.size_bytes == 0:
            raise RemoteProtocolError("manifest: pieces of no size")
        case _:
            pass


def _check_statement(statement: m.Statement) -> None:
    evidence = statement.evidence
    if not evidence.robot_a < evidence.robot_b:
        raise RemoteProtocolError("evidence: robot a is the smaller id")
    if {statement.robot, statement.other} != {evidence.robot_a, evidence.robot_b}:
        raise RemoteProtocolError(f"a statement of {statement.robot} about {statement.other} with evidence about others")
    if evidence.proposer not in (evidence.robot_a, evidence.robot_b):
        raise RemoteProtocolError("evidence: proposed by a robot of the pair")
