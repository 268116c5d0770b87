"""Pull one register of a peer: in one answer, or piece by piece at our own pace when it is large.

Two pieces are in flight at a time: as fast as one big reply, with the beats of a 1 Mbit/s link waiting 0.2 s instead of 1.0 s,
and it still works at 64 kbit/s where one big reply closes the transport (ZENOH.md, section 4).
"""

from __future__ import annotations

import hashlib
import threading
import time
from collections.abc import Callable
from typing import Generic, Protocol, TypeVar

from agent.runtime.guard import Guard
from agent.runtime.pending import NoSuchRegister
from protocol.channels import chunk_register, robot_key
from protocol.codec import decode
from protocol.errors import RemoteProtocolError
from protocol.messages import Chunk, Manifest, Message

CHUNKS_IN_FLIGHT = 2
MAX_RETRIES = 6  # of one pull, over all its pieces
RETRY_PAUSE_S = 0.1  # grows with every retry
LONGEST_PULL_S = 40.0  # the coordinator waits no longer (`fetch_timeout_s`), and after 60 s a puller counts as stuck

P = TypeVar("P")


class Asker(Protocol[P]):
    """What is needed of the exchange: queries that do not wait, and waiting for one of them."""

    def ask(self, key: str, priority: str = "DATA") -> P: ...

    def receive(self, pending: P) -> bytes | None:
        """None: no answer came.  NoSuchRegister: there is none."""


class Pull(Generic[P]):
    """One transfer.  `run` waits, so it belongs on a worker's thread."""

    def __init__(
        self,
        asker: Asker[P],
        guard: Guard,
        fleet: str,
        peer: str,
        closed: threading.Event,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._asker, self._guard = asker, guard
        self._fleet, self._peer, self._closed = fleet, peer, closed
        self._clock, self._until_s = clock, clock() + LONGEST_PULL_S
        self._retries = 0

    def run(self, register: str, *, is_bulk: bool) -> Message | None:
        """The message in that register; None when it did not come, or when what came is not what was promised."""
        try:
            while (message := self._fetch(register, "BACKGROUND" if is_bulk else "DATA")) is not None:
                if not isinstance(message, Manifest):
                    return message
                whole = self._whole(message)
                if whole is not None:
                    return decode(whole)
                if not self._may_retry():
                    return None
        except (NoSuchRegister, RemoteProtocolError):
            pass
        return None

    def _whole(self, manifest: Manifest) -> bytes | None:
        """What the pieces make; None when one gave way to newer answers meanwhile, or is not what was promised."""
        try:
            return self._pieces(manifest)
        except NoSuchRegister:
            return None

    def _pieces(self, manifest: Manifest) -> bytes | None:
        """All pieces joined, when their hash is the promised one."""
        registers = [chunk_register(manifest.digest, i) for i in range(manifest.chunks)]
        asked = {register: self._ask(register, "BACKGROUND") for register in registers[:CHUNKS_IN_FLIGHT]}
        parts = []
        for i, register in enumerate(registers):
            chunk = self._read(asked.pop(register)) or self._fetch(register, "BACKGROUND")
            if not isinstance(chunk, Chunk) or chunk.digest != manifest.digest or chunk.index != i or self._is_over():
                return None
            parts.append(chunk.data)
            if i + CHUNKS_IN_FLIGHT < len(registers):
                following = registers[i + CHUNKS_IN_FLIGHT]
                asked[following] = self._ask(following, "BACKGROUND")
        whole = b"".join(parts)
        return whole if len(whole) == manifest.size_bytes and hashlib.sha256(whole).digest() == manifest.digest else None

    def _fetch(self, register: str, priority: str) -> Message | None:
        """One answer, asked for again when nobody was there just now."""
        while not self._is_over():
            message = self._read(self._ask(register, priority))
            if message is not None or not self._may_retry():
                return message
        return None

    def _may_retry(self) -> bool:
        self._retries += 1
        if self._retries > MAX_RETRIES:
            return False
        self._closed.wait(RETRY_PAUSE_S * self._retries)
        return not self._is_over()

    def _is_over(self) -> bool:
        """Whether nobody waits for the answer any more."""
        return self._closed.is_set() or self._clock() >= self._until_s

    def _ask(self, register: str, priority: str) -> P:
        return self._asker.ask(robot_key(self._fleet, self._peer, register), priority)

    def _read(self, pending: P) -> Message | None:
        answer = self._asker.receive(pending)
        try:
            message = None if answer is None else decode(self._guard.open(answer, self._peer))
        except RemoteProtocolError:
            return None
        return message if message is None or message.robot == self._peer else None
