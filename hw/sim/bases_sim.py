"""What simulated wheel bases share: the counters of whatever turns their wheels, and when their frames are due.

Counters come from a `Counting`, which can also fail: restart at zero, or jump.  The bases themselves are in `kobuki_sim.py`,
`arduino_sim.py`, `roboclaw_sim.py`, `create2_sim.py` and, the WT1 board, in `devices.py`.
"""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from hw import wheels
from hw.sim.devices import LATE_S


class Counter(Protocol):
    """What turns the wheels: ticks of both sides, not wrapped."""

    def ticks_at(self, time_s: float) -> tuple[int, int]: ...


@runtime_checkable
class Drivable(Protocol):
    """A `Counter` whose wheels a client may turn; a robot that explores by itself is none."""

    def turn_wheels(self, left_ticks_per_s: float, right_ticks_per_s: float, now_s: float) -> None: ...


class Counting:
    """Encoder counters that wrap at nothing; `fault` makes them restart or jump."""

    def __init__(self, counter: Counter) -> None:
        self._counter = counter
        self._offset = [0, 0]
        self._was_reset = False

    def fault(self, kind: str, value: float, now_s: float) -> None:
        """`encoder-reset` restarts at zero, `encoder-jump` adds so many ticks to the left wheel."""
        left, right = self._counter.ticks_at(now_s)
        if kind == "encoder-reset":
            self._offset, self._was_reset = [-left, -right], True
        elif kind == "encoder-jump":
            self._offset[0] += round(value)

    def set(self, side: int, ticks: int, now_s: float) -> None:
        """A client sets the counter of the left (0) or right (1) wheel."""
        self._offset[side] = ticks - self._counter.ticks_at(now_s)[side]

    def turn_wheels(self, left_ticks_per_s: float, right_ticks_per_s: float, now_s: float) -> None:
        """A client drives; nothing happens on a robot that goes its own way."""
        if isinstance(self._counter, Drivable):
            self._counter.turn_wheels(left_ticks_per_s, right_ticks_per_s, now_s)

    def at(self, time_s: float) -> tuple[int, int]:
        """Left and right."""
        left, right = self._counter.ticks_at(time_s)
        return left + self._offset[0], right + self._offset[1]

    def sample(self, time_s: float) -> tuple[int, int, bool]:
        """See `TickSource`."""
        was_reset, self._was_reset = self._was_reset, False
        return (*self.at(time_s), was_reset)


class Wt1Ticks(Counting):
    """`TickSource` of a WT1 board."""

    def __init__(self, counter: Counter, info: wheels.InfoFrame) -> None:
        super().__init__(counter)
        self.info = info


class Base:
    """A board that counts, and answers what it hears."""

    def __init__(self, counting: Counting) -> None:
        self.counting = counting
        self._inbox, self._outbox = bytearray(), bytearray()

    def fault(self, kind: str, value: float, now_s: float) -> None:
        """See `Counting.fault`."""
        self.counting.fault(kind, value, now_s)

    def emit(self, now_s: float) -> bytes:
        """See `ByteDevice`."""
        out = bytes(self._outbox)
        self._outbox.clear()
        return out


class Streaming(Base):
    """Sends a frame every `period_s`."""

    def __init__(self, counting: Counting, period_s: float) -> None:
        super().__init__(counting)
        self._period_s = period_s
        self._next_s: float | None = None

    def times(self, now_s: float) -> list[float]:
        """Moments of the frames that are due."""
        if self._next_s is None or now_s - self._next_s > LATE_S:
            self._next_s = now_s
        times = []
        while self._next_s <= now_s:
            times.append(self._next_s)
            self._next_s += self._period_s
        return times
