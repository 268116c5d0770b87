"""Messages to bytes and back.  `decode` returns a message or raises `RemoteProtocolError`: nothing else, whatever the bytes.

    0      2       3      4          8
    | "MQ" | major | kind | crc32 LE | msgpack map {short key: plain value} ...

The checksum covers the two bytes before it and everything behind it.  Unknown map keys are ignored, so fields can be
added; an unknown kind or a higher major version is told apart from damage.
"""

from __future__ import annotations

import zlib
from typing import Any

import msgpack

from protocol import messages as m
from protocol.channels import BY_KIND, BY_NUMBER, CHUNK_BYTES, MAJOR_VERSION, MAX_MESSAGE_BYTES
from protocol.errors import LocalProtocolError, NewerPeer, RemoteProtocolError, TooLarge
from protocol.schemas import believe, plain

MAGIC = b"MQ"
HEADER_BYTES = 8
_MAX_TEXT_BYTES = 1_024  # of any one string
_CHECKED_BYTES = 2_048  # what we say is read back when it is small: that costs microseconds and finds our own mistakes


def encode(message: m.Message) -> bytes:
    """The bytes of a message; a `LocalProtocolError` when we try to say what no peer would believe."""
    channel = BY_KIND[type(message)]
    body = bytes(msgpack.packb(plain(message), use_bin_type=True))
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
    message: m.Message = believe(_unpacked(data[HEADER_BYTES:], channel.max_items), channel.kind)
    _check_sense(message)
    return message


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


def _check_sense(message: m.Message) -> None:
    """What single fields cannot see: parts that contradict one another."""
    match message:
        case m.Statement():
            _check_statement(message)
        case m.Statements():
            _check_statements(message.statements, message.robot, message.boot)
        case m.Estate():
            _check_statements(message.statements, message.gone, message.gone_boot)
            if message.gone == message.robot or message.map.digest != message.delta.digest or message.delta.base_digest:
                raise RemoteProtocolError("an estate: the whole map of another robot")
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


def _check_statements(statements: tuple[m.Statement, ...], robot: str, boot: int) -> None:
    for statement in statements:
        if (statement.robot, statement.boot) != (robot, boot):
            raise RemoteProtocolError(f"statements of {robot} hold one of {statement.robot}")
        _check_statement(statement)


def _check_statement(statement: m.Statement) -> None:
    evidence = statement.evidence
    if not evidence.robot_a < evidence.robot_b:
        raise RemoteProtocolError("evidence: robot a is the smaller id")
    if {statement.robot, statement.other} != {evidence.robot_a, evidence.robot_b}:
        raise RemoteProtocolError(f"a statement of {statement.robot} about {statement.other} with evidence about others")
    if evidence.proposer not in (evidence.robot_a, evidence.robot_b):
        raise RemoteProtocolError("evidence: proposed by a robot of the pair")
