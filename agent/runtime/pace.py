"""How time passes for the workers: as it does, or as a recording says."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Pace:
    """The clock that decisions are made by, and whether a worker that finds nothing to do waits for it."""

    clock: Callable[[], float] = time.monotonic
    is_waiting: bool = True

    def wait_s(self, usual_s: float) -> float:
        """How long to wait where one usually waits this long."""
        return usual_s if self.is_waiting else 0.0


REAL = Pace()
