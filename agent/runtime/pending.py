"""A question to a peer that waits for its answer: what Zenoh's thread and a worker of ours share."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from typing import Any

from agent.runtime.traffic import MAX_PAYLOAD_BYTES

NO_SUCH_REGISTER = b"no such register"  # what is answered then: silence is what a lost answer looks like, and is asked again


class NoSuchRegister(Exception):
    """Who was asked is there, and has nothing of this name (any more): asking again is of no use."""


class Pending:
    """A question on its way, asked once more when it stays silent.  Filled on Zenoh's thread; `wait` from a worker."""

    def __init__(self, ask: Callable[[Pending], bool]) -> None:
        self._arrived: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._ask = ask
        self._asked = 1
        self._ended = self._count = 0
        self._is_denied = False

    def on_reply(self, reply: Any) -> None:
        self._count += 1
        if self._count <= 4:  # one is expected; a liar may send many
            self._arrived.put(reply)

    def on_end(self) -> None:
        self._arrived.put(None)

    def wait(self, timeout_s: float, again_s: float, stopping: threading.Event) -> bytes | None:
        """The first good answer; None when there was none (an empty reply list is how Zenoh says that nobody is there).

        NoSuchRegister: somebody said that there is none, and nobody else had it.
        """
        started_s = time.monotonic()
        while not stopping.is_set() and (waited_s := time.monotonic() - started_s) < timeout_s:
            if waited_s >= again_s and self._asked == 1 and self._ask(self):
                self._asked = 2
            try:
                reply = self._arrived.get(timeout=0.2)
            except queue.Empty:
                continue
            if reply is None:
                self._ended += 1
                if self._ended == self._asked and self._is_denied:
                    raise NoSuchRegister
                if self._ended == self._asked:
                    return None
            elif reply.ok is None:
                self._is_denied |= reply.err.payload.to_bytes() == NO_SUCH_REGISTER  # Zenoh's own timeout comes here too
            elif len(reply.ok.payload) <= MAX_PAYLOAD_BYTES:
                return bytes(reply.ok.payload.to_bytes())
        return None
