"""Pulling a register: whole or in pieces, from peers that are slow, gone, or lying."""

from __future__ import annotations

import hashlib
import threading
from dataclasses import replace

import numpy as np
import pytest

from agent.fleet.options import FleetOptions
from agent.runtime import pulling
from agent.runtime.guard import OpenGuard
from agent.runtime.pending import NoSuchRegister
from agent.runtime.pulling import CHUNKS_IN_FLIGHT, LONGEST_PULL_S, MAX_RETRIES, Pull
from protocol.channels import CHUNK_BYTES, chunk_register, robot_key
from protocol.codec import encode
from protocol.grid import OccupancyGrid
from protocol.messages import Chunk, CoarseMap, Manifest, MapVersion, Message

FLEET, PEER = "lab", "peer"
KEY = "map/coarse"


class Shelf:
    """Registers of a peer; a key may fail to answer a number of times first."""

    def __init__(self) -> None:
        self.content: dict[str, bytes] = {}
        self.silent: dict[str, int] = {}
        self.denied: set[str] = set()
        self.asked: list[str] = []
        self.in_flight = self.most_in_flight = 0
        self.now_s = self.answers_after_s = 0.0

    def put(self, register: str, message: Message) -> None:
        self.content[robot_key(FLEET, PEER, register)] = encode(message)

    def ask(self, key: str, priority: str = "DATA") -> str:
        self.asked.append(key)
        self.in_flight += 1
        self.most_in_flight = max(self.most_in_flight, self.in_flight)
        return key

    def receive(self, pending: str) -> bytes | None:
        self.in_flight -= 1
        self.now_s += self.answers_after_s
        if pending in self.denied:
            raise NoSuchRegister
        if self.silent.get(pending, 0) > 0:
            self.silent[pending] -= 1
            return None
        return self.content.get(pending)


@pytest.fixture
def shelf(monkeypatch: pytest.MonkeyPatch) -> Shelf:
    monkeypatch.setattr(pulling, "RETRY_PAUSE_S", 0.0)
    return Shelf()


def pull(shelf: Shelf, closed: threading.Event | None = None) -> Message | None:
    closed = closed or threading.Event()
    return Pull(shelf, OpenGuard(), FLEET, PEER, closed, clock=lambda: shelf.now_s).run(KEY, is_bulk=True)


def coarse(side: int) -> CoarseMap:
    cells = np.random.default_rng(1).choice(np.array([-1, 0, 100], np.int8), (side, side))
    return CoarseMap(PEER, 7, MapVersion(1, 1, bytes(16)), OccupancyGrid(cells, 0.2))


def shelve_in_pieces(shelf: Shelf, message: Message) -> list[str]:
    """The message as a manifest and its chunks; the chunks' keys."""
    whole = encode(message)
    digest = hashlib.sha256(whole).digest()
    manifest = Manifest(PEER, 7, digest, len(whole), CHUNK_BYTES)
    shelf.put(KEY, manifest)
    for i in range(manifest.chunks):
        shelf.put(chunk_register(digest, i), Chunk(PEER, 7, digest, i, whole[i * CHUNK_BYTES : (i + 1) * CHUNK_BYTES]))
    return [robot_key(FLEET, PEER, chunk_register(digest, i)) for i in range(manifest.chunks)]


def is_the_map(message: Message | None) -> bool:
    return isinstance(message, CoarseMap) and message.grid.cells.shape == (700, 700)


def test_a_small_register_comes_in_one_answer(shelf: Shelf) -> None:
    shelf.put(KEY, coarse(20))
    assert isinstance(pull(shelf), CoarseMap)
    assert len(shelf.asked) == 1


def test_a_large_one_comes_in_pieces_two_at_a_time(shelf: Shelf) -> None:
    keys = shelve_in_pieces(shelf, coarse(700))
    assert len(keys) > 4
    assert is_the_map(pull(shelf))
    assert shelf.most_in_flight == CHUNKS_IN_FLIGHT
    assert len(shelf.asked) == 1 + len(keys)


def test_a_piece_that_did_not_come_is_asked_for_again(shelf: Shelf) -> None:
    keys = shelve_in_pieces(shelf, coarse(700))
    shelf.silent = {keys[0]: 1, keys[3]: 2}
    assert is_the_map(pull(shelf))


def test_nobody_there_is_given_up_after_a_few_tries(shelf: Shelf) -> None:
    assert pull(shelf) is None
    assert len(shelf.asked) == 1 + MAX_RETRIES


def test_a_register_that_is_not_there_is_asked_for_once(shelf: Shelf) -> None:
    shelf.denied = {robot_key(FLEET, PEER, KEY)}
    assert pull(shelf) is None
    assert len(shelf.asked) == 1


def test_pieces_that_gave_way_to_newer_answers_are_cut_anew(shelf: Shelf) -> None:
    keys = shelve_in_pieces(shelf, coarse(700))
    shelf.denied = {keys[2]}
    assert pull(shelf) is None
    assert shelf.asked.count(robot_key(FLEET, PEER, KEY)) == 1 + MAX_RETRIES


def test_a_peer_that_dribbles_holds_a_puller_no_longer_than_its_answer_is_waited_for(shelf: Shelf) -> None:
    shelve_in_pieces(shelf, coarse(700))
    shelf.answers_after_s = 5.0
    assert pull(shelf) is None
    assert LONGEST_PULL_S <= shelf.now_s <= LONGEST_PULL_S + 2 * shelf.answers_after_s
    assert FleetOptions().fetch_timeout_s <= LONGEST_PULL_S


def test_a_lie_about_the_whole_is_found_and_given_up(shelf: Shelf) -> None:
    shelve_in_pieces(shelf, coarse(700))
    manifest = Manifest(PEER, 7, hashlib.sha256(b"something else").digest(), 3 * CHUNK_BYTES, CHUNK_BYTES)
    shelf.put(KEY, manifest)
    for i in range(3):
        shelf.put(chunk_register(manifest.digest, i), Chunk(PEER, 7, manifest.digest, i, bytes(CHUNK_BYTES)))
    assert pull(shelf) is None


def test_a_piece_under_another_number_is_refused(shelf: Shelf) -> None:
    keys = shelve_in_pieces(shelf, coarse(700))
    shelf.content[keys[1]] = shelf.content[keys[2]]
    assert pull(shelf) is None


def test_what_somebody_else_wrote_is_not_taken(shelf: Shelf) -> None:
    shelf.put(KEY, replace(coarse(20), robot="evil"))
    assert pull(shelf) is None


def test_garbage_is_no_message(shelf: Shelf) -> None:
    shelf.content[robot_key(FLEET, PEER, KEY)] = b"\xff" * 100
    assert pull(shelf) is None


def test_closing_ends_a_pull(shelf: Shelf) -> None:
    closed = threading.Event()
    closed.set()
    assert pull(shelf, closed) is None
    assert len(shelf.asked) <= 1
