"""Simulated wheel bases, with the encoders of whatever turns their wheels: Kobuki, ros_arduino_bridge, RoboClaw.

Each takes its counters from a `Counting`, which can also fail: restart at zero, or jump.
"""

from __future__ import annotations

import struct
from typing import Protocol

from hw import arduino_bridge, kobuki, roboclaw, wheels
from hw.sim.devices import LATE_S


class Counter(Protocol):
    """What turns the wheels: ticks of both sides, not wrapped."""

    def ticks_at(self, time_s: float) -> tuple[int, int]: ...


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


class Streaming:
    """A frame every `period_s`."""

    def __init__(self, counting: Counting, period_s: float) -> None:
        self.counting, self._period_s = counting, period_s
        self._next_s: float | None = None

    def fault(self, kind: str, value: float, now_s: float) -> None:
        """See `Counting.fault`."""
        self.counting.fault(kind, value, now_s)

    def times(self, now_s: float) -> list[float]:
        """Moments of the frames that are due."""
        if self._next_s is None or now_s - self._next_s > LATE_S:
            self._next_s = now_s
        times = []
        while self._next_s <= now_s:
            times.append(self._next_s)
            self._next_s += self._period_s
        return times


class KobukiSim(Streaming):
    """Streams core and inertia sub-payloads at 50 Hz from power-up."""

    baud = 115200

    def __init__(self, counting: Counting) -> None:
        super().__init__(counting, 0.02)

    def receive(self, data: bytes, now_s: float) -> None:
        """Commands to drive are not obeyed: the robot explores by itself."""

    def emit(self, now_s: float) -> bytes:
        """See `ByteDevice`."""
        return b"".join(self._frame(time_s) for time_s in self.times(now_s))

    def _frame(self, time_s: float) -> bytes:
        left, right = self.counting.at(time_s)
        core = kobuki.Core(int(time_s * 1e3) % 65536, left % 65536, right % 65536)
        inertia = struct.pack("<BBhhBBB", 4, 7, 0, 0, 0, 0, 0)
        return kobuki.encode(core.encode() + inertia)


class ArduinoBridgeSim:
    """Answers `e`, `r`, `b` and `m`, one line at a time."""

    baud = 57600

    def __init__(self, counting: Counting) -> None:
        self.counting = counting
        self._inbox, self._outbox = bytearray(), bytearray()

    def fault(self, kind: str, value: float, now_s: float) -> None:
        """See `Counting.fault`."""
        self.counting.fault(kind, value, now_s)

    def receive(self, data: bytes, now_s: float) -> None:
        """See `ByteDevice`."""
        self._inbox += data
        *lines, tail = bytes(self._inbox[-256:]).split(b"\r")
        self._inbox[:] = tail
        for line in filter(None, (line.strip() for line in lines)):
            if line == b"e":
                self._outbox += arduino_bridge.encode_counts(*self.counting.at(now_s))
            elif line == b"r":
                self.counting.fault("encoder-reset", 0, now_s)
                self._outbox += b"OK\r\n"
            elif line == b"b":
                self._outbox += b"%d\r\n" % self.baud
            else:
                self._outbox += b"OK\r\n" if line[:1] in b"muo" else b"Invalid Command\r\n"

    def emit(self, now_s: float) -> bytes:
        """See `ByteDevice`."""
        out = bytes(self._outbox)
        self._outbox.clear()
        return out


class RoboClawSim:
    """Answers the usual reads, and says FF to the usual writes; on USB any baud and any address will do."""

    baud = 0

    def __init__(self, counting: Counting) -> None:
        self.counting = counting
        self._inbox, self._outbox = bytearray(), bytearray()
        self._heard_s = 0.0
        self._last: tuple[float, int, int] | None = None  # time and counters at the last question for speeds

    def fault(self, kind: str, value: float, now_s: float) -> None:
        """See `Counting.fault`."""
        self.counting.fault(kind, value, now_s)

    def receive(self, data: bytes, now_s: float) -> None:
        """See `ByteDevice`; half a command is dropped when the rest does not follow."""
        if now_s - self._heard_s > PARTIAL_COMMAND_S:
            self._inbox.clear()
        self._heard_s = now_s
        self._inbox += data
        while len(self._inbox) >= 2:
            if not roboclaw.FIRST_ADDRESS <= self._inbox[0] <= roboclaw.LAST_ADDRESS:
                del self._inbox[0]
                continue
            n = _ROBOCLAW_WRITES.get(self._inbox[1])
            size = 2 if n is None else 4 + n
            if len(self._inbox) < size:
                return
            command = bytes(self._inbox[:size])
            del self._inbox[:size]
            if n is None:
                self._tell(command, now_s)
            elif roboclaw.crc16(command) == 0:
                self._obey(command, now_s)

    def _obey(self, command: bytes, now_s: float) -> None:
        if command[1] == roboclaw.RESET_ENCODERS:
            self.counting.fault("encoder-reset", 0, now_s)
        self._outbox += b"\xff"

    def _tell(self, question: bytes, now_s: float) -> None:
        left, right = self.counting.at(now_s)
        counts = {roboclaw.READ_M1: left, roboclaw.READ_M2: right}
        code = question[1]
        if code in counts:
            self._say(question, struct.pack(">IB", counts[code] % 2**32, 0))
        elif code in (18, 19, 30, 31):
            speed = self._speeds(now_s, left, right)[code in (19, 31)]
            self._say(question, struct.pack(">iB", speed, speed < 0))
        elif code == 79:
            self._say(question, struct.pack(">ii", *self._speeds(now_s, left, right)))
        elif code == roboclaw.READ_ENCODERS:
            self._say(question, struct.pack(">II", left % 2**32, right % 2**32))
        elif code in _ROBOCLAW_FACTS:
            self._say(question, _ROBOCLAW_FACTS[code])

    def _speeds(self, now_s: float, left: int, right: int) -> tuple[int, int]:
        """Ticks a second since the last such question."""
        before_s, before_left, before_right = self._last or (now_s, left, right)
        if now_s - before_s > 0.01 or self._last is None:
            self._last = now_s, left, right
        seconds = max(now_s - before_s, 0.01)
        return round((left - before_left) / seconds), round((right - before_right) / seconds)

    def _say(self, question: bytes, data: bytes) -> None:
        self._outbox += roboclaw.sealed(question, data)

    def emit(self, now_s: float) -> bytes:
        """See `ByteDevice`."""
        out = bytes(self._outbox)
        self._outbox.clear()
        return out


PARTIAL_COMMAND_S = 0.03  # the board's 10 ms, and what a busy computer adds
_ROBOCLAW_FACTS = {
    roboclaw.READ_VERSION: b"USB Roboclaw 2x15a v4.1.34\n\0",
    roboclaw.READ_MAIN_BATTERY: struct.pack(">H", 124),  # tenths of a volt
    25: struct.pack(">H", 50),
    48: struct.pack(">hh", 0, 0),  # duty
    49: struct.pack(">hh", 0, 0),  # hundredths of an ampere
    82: struct.pack(">H", 250),  # tenths of a degree
    90: struct.pack(">I", 0),  # no fault
}
_ROBOCLAW_WRITES = dict.fromkeys((0, 1, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14), 1) | {20: 0, 22: 4, 23: 4, 28: 16, 29: 16}
_ROBOCLAW_WRITES |= {32: 2, 33: 2, 34: 4, 35: 4, 36: 4, 37: 8, 38: 8, 39: 8, 40: 12}  # bytes behind address and command
