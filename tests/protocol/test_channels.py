"""The table of channels and the keys it makes."""

from __future__ import annotations

import pytest

from protocol.channels import (
    CHANNELS,
    CHUNK_BYTES,
    MAX_PUSH_BYTES,
    PUSHED_REGISTERS,
    chunk_register,
    fine_register,
    fleet_key,
    global_register,
    parse_key,
    push_register,
    robot_key,
    subscriptions,
)
from protocol.codec import encode
from protocol.errors import LocalProtocolError, RemoteProtocolError
from protocol.messages import Chunk
from tests.protocol.examples import examples


def test_keys_are_what_the_protocol_says() -> None:
    assert robot_key("lab", "r1", "map/feat") == "mapquilt/@v1/lab/r/r1/map/feat"
    assert fleet_key("lab") == "mapquilt/@v1/lab/**"
    assert fine_register(b"", b"\x01" * 16) == "map/fine/-/" + "01" * 16
    assert global_register(b"\x02" * 16, b"") == "global/tiles/" + "02" * 16 + "/-"
    assert chunk_register(b"\x03" * 32, 4) == "blob/" + "03" * 32 + "/4"


def test_everything_pushed_is_subscribed_to() -> None:
    pushed = {channel.register.replace("{other}", "*") for channel in CHANNELS if channel.is_pushed}
    assert pushed == set(PUSHED_REGISTERS)
    assert "mapquilt/@v1/lab/r/*/beat" in subscriptions("lab")


@pytest.mark.parametrize("name", ["hello", "beat", "feat", "edge", "global"])
def test_a_key_tells_fleet_robot_and_register_again(name: str) -> None:
    message = examples()[name]
    key = robot_key("lab", message.robot, push_register(message))
    assert parse_key(key) == ("lab", message.robot, push_register(message))


@pytest.mark.parametrize("name", ["coarse", "fine", "edges", "globaltiles", "manifest", "chunk"])
def test_large_answers_are_never_pushed(name: str) -> None:
    with pytest.raises(LocalProtocolError, match="never pushed"):
        push_register(examples()[name])


@pytest.mark.parametrize(
    "key",
    ["", "x", "mapquilt/@v2/lab/r/r1/beat", "mapquilt/@v1/lab/r/R1/beat", "mapquilt/@v1/lab/r/r1", "mapquilt/@v1/LAB/r/r1/beat",
     "mapquilt/@v1/lab/q/r1/beat", "mapquilt/@v1/lab/r/r1/" + "x" * 300, "mapquilt/@v1/../r/r1/beat"],
)  # fmt: skip
def test_other_keys_are_refused(key: str) -> None:
    with pytest.raises(RemoteProtocolError):
        parse_key(key)


@pytest.mark.parametrize("name", ["", "R1", "a/b", "*", "a" * 33, "@v1"])
def test_a_name_that_would_break_a_key_makes_no_key(name: str) -> None:
    with pytest.raises(LocalProtocolError, match="no name"):
        robot_key("lab", name, "beat")


def test_a_full_piece_fits_one_push() -> None:
    assert len(encode(Chunk("r" * 32, 2**64 - 1, bytes(32), 2**16 - 1, bytes(CHUNK_BYTES)))) <= MAX_PUSH_BYTES
