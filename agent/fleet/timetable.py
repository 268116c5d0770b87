"""Time as the fleet logic sees it: a clock that only flows forward, and what is due when."""

from __future__ import annotations

import math
from dataclasses import dataclass

LONG_AGO_S, NEVER_S = -math.inf, math.inf


class Clock:
    """Time that only flows forward, and never faster than it is watched.

    A clock set back stands still until it has caught up; a process that was stopped for a minute wakes up as if two seconds
    had passed, because the beats of that minute still wait in its inbox and nobody is lost.
    """

    _LONGEST_STEP_S = 2.0

    def __init__(self) -> None:
        self._given_s: float | None = None
        self.now_s = 0.0

    def at(self, given_s: float) -> float:
        step_s = 0.0 if self._given_s is None else given_s - self._given_s
        self._given_s = given_s
        self.now_s += min(max(step_s, 0.0), self._LONGEST_STEP_S)
        return self.now_s


@dataclass(slots=True)
class Timetable:
    """Moments of `Clock` before which nothing is done."""

    next_beat_s: float = LONG_AGO_S
    next_announce_s: float = LONG_AGO_S
    next_scan_s: float = LONG_AGO_S
    next_hello_s: float = LONG_AGO_S
