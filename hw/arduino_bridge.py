"""ros_arduino_bridge: ASCII lines, one question and one answer at a time.

    e CR          ->  "<left> <right>" CR LF        both counters, 32-bit signed
    r CR          ->  "OK" CR LF                    counters to zero
    b CR          ->  the baud rate
    other         ->  "Invalid Command" CR LF       SERIAL.md 7.3

There is no checksum, so only a line that is exactly two numbers counts, and the odometry bounds what they may mean.
"""

from __future__ import annotations

import re

from hw.framing import Counters
from hw.odometry import Quiet, TickSample, WheelGeometry

BAUD_RATES = (57600, 115200)  # the sketch's own; many forks
ASK_ENCODERS = b"e\r"
MAX_LINE_BYTES = 64
POLL_PERIOD_S = 1 / 30  # the rate of its PID loop: asking faster gives nothing new
MOVED_TICKS = 20  # counters that were further from zero than this and read exactly zero were reset

_ENCODERS = re.compile(rb"(-?\d{1,10}) (-?\d{1,10})")


def encode_counts(left: int, right: int) -> bytes:
    """The answer to `e`."""
    return b"%d %d\r\n" % (left, right)


def decode_counts(line: bytes) -> tuple[int, int] | None:
    """Both counters, or None when the line is something else."""
    match = _ENCODERS.fullmatch(line)
    if match is None:
        return None
    left, right = int(match[1]), int(match[2])
    return (left, right) if min(left, right) >= -(2**31) and max(left, right) < 2**31 else None


class ArduinoBridge(Quiet):
    """`BaseProtocol`: asks for the counters; the geometry is the builder's own and comes from the URL."""

    baud_rates: tuple[int, ...] = BAUD_RATES
    poll_period_s = POLL_PERIOD_S

    def __init__(self, geometry: WheelGeometry) -> None:
        self.geometry = geometry
        self.counters = Counters()
        self._pending = bytearray()
        self._last = (0, 0)

    def start_requests(self) -> list[bytes]:
        """End whatever half a command an earlier program left."""
        return [b"\r"]

    def poll_request(self) -> bytes:
        """See `BaseProtocol`."""
        return ASK_ENCODERS

    def feed(self, data: bytes) -> list[TickSample]:
        """See `BaseProtocol`."""
        self.counters.bytes_in += len(data)
        *lines, tail = (bytes(self._pending) + data).split(b"\n")
        self._pending[:] = tail[-MAX_LINE_BYTES:]
        samples = []
        for line in lines:
            counts = decode_counts(line.strip(b"\r"))
            if counts is None:
                self.counters.skip(len(line) + 1)
                continue
            self.counters.good()
            is_reset = counts == (0, 0) and max(map(abs, self._last)) > MOVED_TICKS
            samples.append(TickSample(*counts, 32, is_reset=is_reset))
            self._last = counts
        return samples
