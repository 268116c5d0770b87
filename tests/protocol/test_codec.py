"""Messages and their bytes: exact, total, bounded."""

from __future__ import annotations

import json
import random
import struct
import time
import tracemalloc
import zlib
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol.channels import BY_KIND, BY_NUMBER, CHANNELS, MAX_ANSWER_BYTES
from protocol.codec import HEADER_BYTES, MAGIC, decode, encode
from protocol.errors import LocalProtocolError, NewerPeer, RemoteProtocolError, TooLarge
from protocol.features import FeatureMap
from protocol.geometry import SE2
from protocol.grid import OccupancyGrid
from protocol.messages import Beat, Evidence, MapAnnouncement, Message, Stance, Statement
from protocol.schemas import SCHEMAS
from tests.protocol.examples import evidence, examples

GOLDEN = json.loads((Path(__file__).parent / "golden_v1.json").read_text())
NAMES = sorted(examples())


def same(a: Any, b: Any) -> bool:
    """Deep equality that looks into arrays and grids; features within their quantum."""
    if isinstance(a, FeatureMap):
        return all(np.allclose(getattr(a, f.name), getattr(b, f.name), atol=0.006) for f in fields(a))
    if isinstance(a, OccupancyGrid):
        return np.array_equal(a.cells, b.cells) and (a.resolution_m, a.origin) == (b.resolution_m, b.origin)
    if isinstance(a, tuple):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    if is_dataclass(a):
        return type(a) is type(b) and all(same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))
    return bool(a == b)


def body_of(message: Message) -> dict[str, Any]:
    return msgpack.unpackb(encode(message)[HEADER_BYTES:])


def wrapped(name: str, body: Any, major: int = 1) -> bytes:
    """Any body in a correct envelope."""
    number = next(channel.number for channel in CHANNELS if channel.name == name)
    return enveloped(number, msgpack.packb(body), major)


def enveloped(number: int, packed: bytes, major: int = 1) -> bytes:
    head = bytes((major, number))
    return MAGIC + head + zlib.crc32(packed, zlib.crc32(head)).to_bytes(4, "little") + packed


@pytest.mark.parametrize("name", NAMES)
def test_the_bytes_of_every_kind_never_change(name: str) -> None:
    assert encode(examples()[name]).hex() == GOLDEN[name]


@pytest.mark.parametrize("name", NAMES)
def test_every_kind_comes_back(name: str) -> None:
    message = examples()[name]
    back = decode(bytes.fromhex(GOLDEN[name]))
    assert same(back, message)
    assert encode(back) == encode(message)


def test_every_channel_has_an_example_and_a_schema() -> None:
    assert {channel.name for channel in CHANNELS} == set(NAMES)
    assert all(channel.kind in SCHEMAS for channel in CHANNELS)
    assert len(BY_NUMBER) == len(BY_KIND) == len(CHANNELS)


@pytest.mark.parametrize("kind", SCHEMAS, ids=lambda kind: kind.__name__)
def test_every_schema_names_every_field_once(kind: type) -> None:
    schema = SCHEMAS[kind]
    assert [f.name for f in fields(kind)] == [f.name for f in schema] or {f.name for f in fields(kind)} == {
        f.name for f in schema
    }
    assert len({f.key for f in schema}) == len(schema)


@pytest.mark.parametrize("name", NAMES)
def test_unknown_fields_are_ignored_so_that_fields_can_be_added(name: str) -> None:
    message = examples()[name]
    assert same(decode(wrapped(name, body_of(message) | {"zz": [1, {"new": 2.5}]})), message)


def test_a_field_with_a_default_may_be_missing() -> None:
    body = body_of(examples()["beat"])
    for key in ("T", "F", "L"):
        body.pop(key, None)
    beat = decode(wrapped("beat", body))
    assert isinstance(beat, Beat)
    assert beat.T_map_robot is None
    assert beat.load == 0.0


@pytest.mark.parametrize("name", NAMES)
def test_a_required_field_may_not_be_missing(name: str) -> None:
    body = body_of(examples()[name])
    required = {f.key for f in SCHEMAS[type(examples()[name])] if f.name in ("robot", "boot")}
    for key in required:
        with pytest.raises(RemoteProtocolError, match="missing"):
            decode(wrapped(name, {k: v for k, v in body.items() if k != key}))


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    "wrong", [None, -1, 2**70 - 2**69, 1e300, float("nan"), "x", "\x1b[31m", b"", [], {}, True, [[]], b"\xff" * 20]
)
def test_a_field_of_the_wrong_sort_is_refused_or_means_itself(name: str, wrong: Any) -> None:
    message = examples()[name]
    body = body_of(message)
    if isinstance(wrong, int) and wrong > 2**64:
        wrong = 2**64 - 1
    for key in body:
        try:
            back = decode(wrapped(name, body | {key: wrong}))
        except RemoteProtocolError:
            continue
        assert same(decode(encode(back)), back)


@pytest.mark.parametrize("name", NAMES)
def test_every_cut_and_every_flipped_bit_is_refused(name: str) -> None:
    data = bytes.fromhex(GOLDEN[name])
    for i in range(len(data)):
        with pytest.raises(RemoteProtocolError):
            decode(data[:i])
    rng = random.Random(name)
    for _ in range(300):
        changed = bytearray(data)
        changed[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        with pytest.raises(RemoteProtocolError):
            decode(bytes(changed))
    with pytest.raises(RemoteProtocolError):
        decode(data + b"\x00")
    with pytest.raises(RemoteProtocolError):
        decode(b"\x00" + data)


@given(st.binary(max_size=400))
@settings(max_examples=300, deadline=None)
def test_garbage_is_refused(data: bytes) -> None:
    for garbage in (data, MAGIC + data, *(enveloped(number, data) for number in BY_NUMBER)):
        with pytest.raises(RemoteProtocolError):
            decode(garbage)


def test_a_newer_peer_is_told_apart_from_damage() -> None:
    body = body_of(examples()["hello"])
    with pytest.raises(NewerPeer, match="version 2"):
        decode(wrapped("hello", body, major=2))
    with pytest.raises(RemoteProtocolError) as caught:
        decode(wrapped("hello", body, major=0))
    assert not isinstance(caught.value, NewerPeer)


BOMBS = {
    "an array that claims four billion": b"\xdd\xff\xff\xff\xff",
    "a map that claims four billion": b"\xdf\xff\xff\xff\xff",
    "a string that claims four billion": b"\xdb\xff\xff\xff\xff",
    "a hundred thousand nested arrays": b"\x91" * 100_000,
    "a hundred thousand nested maps": b"\x81\xa1a" * 100_000,
    "a megabyte of empty arrays": b"\xdc\xff\xff" + b"\x90" * 65_535,
    "an extension type": b"\xc7\x05\x07hello",
    "a time stamp": b"\xd6\xff\x00\x00\x00\x01",
    "a key that is a number": b"\x81\x01\x02",
    "invalid utf-8": b"\x81\xa2\xff\xfe\x01",
    "a key that is a list": b"\x81\x91\x01\x02",
    "five megabytes of short strings": b"\xdc\x00\x30" + (b"\xdc\x00\x30" + b"\xa3abc" * 48) * 26_000,
    "many claims inside one another": b"\xdc\x00\x40" * 300,
}


@pytest.mark.parametrize("bomb", BOMBS.values(), ids=BOMBS)
def test_a_bomb_is_refused_at_once_and_in_little_memory(bomb: bytes) -> None:
    tracemalloc.start()
    started_s = time.process_time()
    for number in BY_NUMBER:
        with pytest.raises(RemoteProtocolError):
            decode(enveloped(number, bomb))
    spent_s = time.process_time() - started_s
    peak_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak_bytes < 1_000_000 + 4 * len(bomb)
    assert spent_s < 1.0


def test_a_message_longer_than_its_channel_allows_is_refused_before_it_is_unpacked() -> None:
    with pytest.raises(TooLarge):
        decode(enveloped(2, bytes(600)))
    with pytest.raises(TooLarge):
        decode(enveloped(5, bytes(MAX_ANSWER_BYTES)))


@given(
    st.floats(allow_nan=True, allow_infinity=True),
    st.floats(allow_nan=True, allow_infinity=True),
    st.floats(allow_nan=True, allow_infinity=True),
)
@settings(max_examples=300, deadline=None)
def test_a_transform_from_outside_is_finite_near_and_normalised(x: float, y: float, theta: float) -> None:
    body = body_of(examples()["beat"]) | {"T": struct.pack("<3d", x, y, theta)}
    try:
        beat = decode(wrapped("beat", body))
    except RemoteProtocolError:
        return
    assert isinstance(beat, Beat)
    T = beat.T_map_robot
    assert T is not None
    assert T.is_finite()
    assert max(abs(T.x_m), abs(T.y_m)) <= 1e6
    assert -np.pi <= T.theta_rad <= np.pi
    assert "-0.0" not in (str(T.x_m), str(T.y_m), str(T.theta_rad))


@pytest.mark.parametrize(
    "entries", [(-1, 0, 0, 1, 0, 1), (1, 5, 0, 1, 0, 1), (1, 0, 0, 1, 9, 1), (float("inf"),) * 6, (1e13, 0, 0, 1, 0, 1)]
)
def test_a_covariance_that_is_none_is_refused(entries: tuple[float, ...]) -> None:
    body = body_of(examples()["edge"])
    body["e"]["c"] = struct.pack("<6d", *entries)
    with pytest.raises(RemoteProtocolError):
        decode(wrapped("edge", body))


@pytest.mark.parametrize("name", ["", "A", "a/b", "-a", "a" * 33, "r*", "é", "a b", "@a", "r1\n"])
def test_a_name_that_could_not_be_a_key_is_refused(name: str) -> None:
    body = body_of(examples()["hello"])
    with pytest.raises(RemoteProtocolError):
        decode(wrapped("hello", body | {"r": name}))


def test_evidence_about_others_or_in_the_wrong_order_is_refused() -> None:
    said = examples()["edge"]
    assert isinstance(said, Statement)
    good: Evidence = evidence()
    bad = [
        replace(said, other="cedar"),
        replace(said, evidence=replace(good, robot_a="birch", robot_b="amber")),
        replace(said, evidence=replace(good, proposer="cedar")),
        replace(said, evidence=replace(good, robot_b="amber")),
    ]
    for statement in bad:
        with pytest.raises(LocalProtocolError):
            encode(statement)


def test_what_no_peer_would_believe_is_not_sent() -> None:
    beat = examples()["beat"]
    assert isinstance(beat, Beat)
    for bad in (
        replace(beat, robot="No Such Name"),
        replace(beat, load=2.0),
        replace(beat, seq=-1),
        replace(beat, edges_digest=b"1"),
    ):
        with pytest.raises(LocalProtocolError):
            encode(bad)


def test_features_travel_within_their_quantum_and_at_a_third_of_their_size() -> None:
    rng = np.random.default_rng(1)
    n = 60
    lines = np.stack(
        [
            rng.uniform(-40, 40, n), rng.uniform(-40, 40, n), rng.choice([0, 1.57, -1.57, 3.1], n) + rng.normal(0, 0.02, n),
            rng.uniform(0.8, 12, n), rng.uniform(0.001, 0.02, n), rng.uniform(0.003, 0.03, n),
        ],
        axis=1,
    ).astype(np.float32)  # fmt: skip
    base = examples()["feat"]
    assert isinstance(base, MapAnnouncement)
    data = encode(replace(base, features=FeatureMap(lines=lines)))
    back = decode(data)
    assert isinstance(back, MapAnnouncement)
    error = np.abs(back.features.lines - lines)
    error[:, 2] = np.abs((error[:, 2] + np.pi) % (2 * np.pi) - np.pi)
    assert np.all(error.max(axis=0) <= [0.003, 0.003, 0.0001, 0.006, 0.0001, 0.0003])
    assert len(data) <= 1_024  # the target for an indoor map


def test_a_beat_and_a_statement_stay_small() -> None:
    assert len(encode(examples()["beat"])) <= 300
    assert len(encode(examples()["edge"])) <= 400


def test_evidence_is_named_by_everything_in_it() -> None:
    good = evidence()
    names = {good.id()}
    changes: list[dict[str, Any]] = [
        {"proposer": "birch"}, {"T_a_b": SE2(1.5, -2.25, 0.7500001)}, {"agree": 901}, {"disagree": 41}, {"score": 31.0},
        {"overlap_m2": 23.0}, {"covariance": (0.01, 0.001, 0.0, 0.02, 0.0, 0.0004)}, {"map_a": replace(good.map_a, revision=4)},
        {"map_b": replace(good.map_b, frame=1)}, {"robot_b": "cedar"},
    ]  # fmt: skip
    for change in changes:
        names.add(replace(good, **change).id())
    assert len(names) == len(changes) + 1
    said = decode(encode(Statement("amber", 1, 1, "birch", Stance.PROPOSE, good)))
    assert isinstance(said, Statement)
    assert said.evidence.id() == good.id()
