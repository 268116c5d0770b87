"""Simulated time: what is to happen, in order, and waiting for what should come of it."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable


class Timeline:
    """Events by the moment at which they happen; those of one moment in the order in which they were put."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._order = itertools.count()

    def describe(self) -> str:
        """What a failed test shows."""
        return f"t={self.now_s:.1f}"

    def at(self, delay_s: float, action: Callable[[], None]) -> None:
        heapq.heappush(self._events, (self.now_s + delay_s, next(self._order), action))

    def run(self, duration_s: float) -> None:
        end_s = self.now_s + duration_s
        while self._events and self._events[0][0] <= end_s:
            self.now_s, _, action = heapq.heappop(self._events)
            action()
        self.now_s = end_s

    def run_until(self, condition: Callable[[], bool], timeout_s: float, step_s: float = 0.2) -> float:
        """Simulated seconds until the condition holds; fails the test when it does not in time."""
        start_s = self.now_s
        while not condition():
            assert self.now_s - start_s < timeout_s, f"not within {timeout_s} simulated seconds: {self.describe()}"
            self.run(step_s)
        return self.now_s - start_s
