"""Where threads meet: a mailbox of one slot, and a mailbox of one slot per key.

A value that nobody took yet is replaced by the next one, so a slow reader never delays a fast writer and memory never
grows.  Both count what they replaced: a reader that falls behind can be seen.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from typing import Generic, TypeVar

T = TypeVar("T")


class Latest(Generic[T]):
    """One slot.  `put` never waits; `take` waits for the next value, at most `timeout_s`."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._value: T | None = None
        self.replaced = 0  # values that were overwritten before anybody took them

    def put(self, value: T) -> None:
        with self._changed:
            self.replaced += self._value is not None
            self._value = value
            self._changed.notify()

    def take(self, timeout_s: float = 0.0) -> T | None:
        """The newest value, which leaves the slot; None when none came in time."""
        with self._changed:
            if self._value is None and timeout_s > 0.0:
                self._changed.wait_for(lambda: self._value is not None, timeout_s)
            value, self._value = self._value, None
            return value


class KeyedLatest(Generic[T]):
    """One slot per key, taken oldest key first; at most `max_keys` keys, the oldest gives way.

    This stands between the network's thread and ours: `put` is all that a Zenoh callback may do.
    """

    def __init__(self, max_keys: int) -> None:
        self._changed = threading.Condition()
        self._slots: OrderedDict[str, T] = OrderedDict()
        self._max_keys = max_keys
        self.replaced = 0  # a newer value of the same key came first
        self.dropped = 0  # a whole key gave way

    def put(self, key: str, value: T) -> None:
        with self._changed:
            if key in self._slots:
                self.replaced += 1  # the key keeps its turn: a talkative peer does not push the others back
            elif len(self._slots) >= self._max_keys:
                self._slots.popitem(last=False)
                self.dropped += 1
            self._slots[key] = value
            self._changed.notify()

    def take(self, timeout_s: float = 0.0) -> tuple[str, T] | None:
        """The key that waits longest with its newest value; None when none came in time."""
        with self._changed:
            if not self._slots and timeout_s > 0.0:
                self._changed.wait_for(lambda: bool(self._slots), timeout_s)
            return self._slots.popitem(last=False) if self._slots else None

    def wake(self) -> None:
        """Let a waiting `take` look again (used when stopping)."""
        with self._changed:
            self._changed.notify_all()

    def __len__(self) -> int:
        return len(self._slots)
