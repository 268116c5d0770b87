"""ros_arduino_bridge: ASCII lines, one question and one answer at a time.

    e CR          ->  "<left> <right>" CR LF        both counters, 32-bit signed
    r CR          ->  "OK" CR LF                    counters to zero
    b CR          ->  the baud rate
    other         ->  "Invalid Command" CR LF       SERIAL.md 7.3

There is no checksum, so each question is asked twice and a line counts only when it is exactly two numbers that the line before
it told too; numbers far from the last ones believed need two such pairs.
"""

from __future__ import annotations

import math
import re

from hw.byte_window import Counters
from hw.odometry import Quiet, TickSample, WheelGeometry

BAUD_RATES = (57600, 115200)  # the sketch's own; many forks
ASK_ENCODERS = b"e\r"
TIMES_ASKED = 2
MAX_LINE_BYTES = 64
POLL_PERIOD_S = 1 / 30  # the rate of its PID loop: asking faster gives nothing new
SAME_S = 0.01  # two answers to one question differ by no more than the wheels can turn meanwhile: 2 ms on the line, and slack
NEAR_S = 1.5 * POLL_PERIOD_S  # as far can the counters be from those of the last question
LINES_TO_JUMP = 2 * TIMES_ASKED  # that agree, before counters are believed that are elsewhere

Counts = tuple[int, int]  # left, right

_ENCODERS = re.compile(rb"(-?\d{1,10}) (-?\d{1,10})")


def encode_counts(left: int, right: int) -> bytes:
    """The answer to `e`."""
    return b"%d %d\r\n" % (left, right)


def decode_counts(line: bytes) -> Counts | None:
    """Both counters, or None when the line is something else."""
    match = _ENCODERS.fullmatch(line)
    if match is None:
        return None
    left, right = int(match[1]), int(match[2])
    return (left, right) if min(left, right) >= -(2**31) and max(left, right) < 2**31 else None


class Agreement:
    """Tells which lines to believe, by what the lines before them said."""

    def __init__(self, geometry: WheelGeometry) -> None:
        ticks_per_s = geometry.max_speed_mps / geometry.metres_per_tick
        self._same_ticks, self._near_ticks = ticks_per_s * SAME_S, ticks_per_s * NEAR_S
        self._before: Counts | None = None  # the line before, when it was not believed: it may be the first of a pair
        self._latest: Counts | None = None
        self._believed: Counts | None = None
        self._lines = 0  # in a row, each near the one before

    def is_believed(self, counts: Counts) -> bool:
        """Is this line, the next that came, to be believed?"""
        self._lines = self._lines + 1 if _distance(counts, self._latest) <= self._near_ticks else 1
        is_told_twice = _distance(counts, self._before) <= self._same_ticks
        is_near = _distance(counts, self._believed) <= self._near_ticks or self._lines >= LINES_TO_JUMP
        self._latest = counts
        if not (is_told_twice and is_near):
            self._before = counts
            return False
        self._before, self._believed = None, counts
        return True

    def is_reset(self, counts: Counts) -> bool:
        """Are these, compared with the last ones believed, counters that began again at zero?"""
        return _distance(counts, (0, 0)) <= self._near_ticks < _distance(counts, self._believed) < math.inf


def _distance(a: Counts, b: Counts | None) -> float:
    return math.inf if b is None else max(abs(a[0] - b[0]), abs(a[1] - b[1]))


class ArduinoBridge(Quiet):
    """`BaseProtocol`: asks for the counters; the geometry is the builder's own and comes from the URL."""

    baud_rates: tuple[int, ...] = BAUD_RATES
    poll_period_s = POLL_PERIOD_S

    def __init__(self, geometry: WheelGeometry) -> None:
        self.geometry = geometry
        self.counters = Counters()
        self._pending = bytearray()
        self._agreement = Agreement(geometry)

    def start_requests(self) -> list[bytes]:
        """End whatever half a command an earlier program left."""
        return [b"\r"]

    def poll_request(self) -> bytes:
        """See `BaseProtocol`."""
        return TIMES_ASKED * ASK_ENCODERS

    def feed(self, data: bytes) -> list[TickSample]:
        """See `BaseProtocol`."""
        self.counters.bytes_in += len(data)
        *lines, tail = (bytes(self._pending) + data).split(b"\n")
        self._pending[:] = tail[-MAX_LINE_BYTES:]
        samples = []
        for line in lines:
            counts = decode_counts(line.strip())
            if counts is None:
                self.counters.skip(len(line) + 1)
                continue
            self.counters.good()
            is_reset = self._agreement.is_reset(counts)
            if self._agreement.is_believed(counts):
                samples.append(TickSample(*counts, 32, is_reset=is_reset))
        return samples
