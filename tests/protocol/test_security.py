"""The shared secret: what it lets through, and what it does not."""

from __future__ import annotations

import random

import pytest

from protocol.errors import LocalProtocolError, RemoteProtocolError
from protocol.security import SEAL_BYTES, ReplayWindow, Sealer, derive_key, open_seal, seal, unseal

KEY = bytes(range(32))


def test_a_sealed_message_opens_with_the_same_secret() -> None:
    sealed = unseal(KEY, seal(KEY, "amber", 7, 1, b"words"))
    assert (sealed.sender, sealed.boot, sealed.counter, sealed.payload) == ("amber", 7, 1, b"words")


def test_the_seal_costs_no_more_than_it_says() -> None:
    assert len(seal(KEY, "r" * 32, 2**64 - 1, 2**64 - 1, b"")) == SEAL_BYTES


def test_the_bytes_of_a_seal_never_change() -> None:
    golden = "4d530105616d62657207000000000000000100000000000000"
    data = seal(KEY, "amber", 7, 1, b"words")
    assert data.hex().startswith(golden)
    assert data.hex() == golden + "aae22189eef7d1563137861a46ac6b6e" + b"words".hex()


def test_another_secret_or_any_changed_bit_is_refused() -> None:
    data = seal(KEY, "amber", 7, 1, b"words")
    with pytest.raises(RemoteProtocolError):
        unseal(bytes(32), data)
    for i in range(len(data)):
        for bit in range(8):
            changed = bytearray(data)
            changed[i] ^= 1 << bit
            with pytest.raises(RemoteProtocolError):
                unseal(KEY, bytes(changed))
        with pytest.raises(RemoteProtocolError):
            unseal(KEY, data[:i])


def test_ten_thousand_replays_are_refused() -> None:
    sealer, window = Sealer(KEY, "amber", 7), ReplayWindow()
    recorded = [sealer.seal(b"%d" % i) for i in range(10_000)]
    for data in recorded:
        open_seal(KEY, window, data)
    random.Random(1).shuffle(recorded)
    accepted = 0
    for data in recorded:
        try:
            open_seal(KEY, window, data)
            accepted += 1
        except RemoteProtocolError:
            pass
    assert accepted == 0


def test_messages_out_of_order_pass_once_each() -> None:
    sealer, window = Sealer(KEY, "amber", 7), ReplayWindow()
    late = [sealer.seal(b"%d" % i) for i in range(1_000)]
    random.Random(2).shuffle(late)
    for data in late:
        open_seal(KEY, window, data)
    for data in late:
        with pytest.raises(RemoteProtocolError, match="replay"):
            open_seal(KEY, window, data)


def test_a_restart_begins_a_new_count() -> None:
    window = ReplayWindow()
    open_seal(KEY, window, Sealer(KEY, "amber", 7).seal(b"a"))
    open_seal(KEY, window, Sealer(KEY, "amber", 8).seal(b"a"))


def test_a_secret_that_can_be_guessed_is_refused() -> None:
    with pytest.raises(LocalProtocolError, match="8 or more"):
        derive_key("1234", "lab")
    assert derive_key("correct horse", "lab") != derive_key("correct horse", "yard")
