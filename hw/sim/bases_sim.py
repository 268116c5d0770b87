"""Simulated wheel bases: Create 2, Kobuki, ros_arduino_bridge and RoboClaw, with the encoders of whatever turns their wheels.

Each takes its counters from a `Counting`, which can also fail: restart at zero, or jump.
"""

from __future__ import annotations

import struct
from typing import Protocol

from hw import arduino_bridge, create2, kobuki, roboclaw, wheels
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


class _Streaming:
    """A frame every `period_s`."""

    def __init__(self, counting: Counting, period_s: float) -> None:
        self.counting, self._period_s = counting, period_s
        self._next_s: float | None = None

    def fault(self, kind: str, value: float, now_s: float) -> None:
        """See `Counting.fault`."""
        self.counting.fault(kind, value, now_s)

    def _times(self, now_s: float) -> list[float]:
        if self._next_s is None or now_s - self._next_s > LATE_S:
            self._next_s = now_s
        times = []
        while self._next_s <= now_s:
            times.append(self._next_s)
            self._next_s += self._period_s
        return times


class Create2Sim(_Streaming):
    """Answers 149 (query), 148 (stream) and 150 (pause); starts in the off mode, as after power-up."""

    baud = 115200

    def __init__(self, counting: Counting) -> None:
        super().__init__(counting, 0.015)
        self._inbox, self._outbox = bytearray(), bytearray()
        self._packets: list[int] = []
        self._is_streaming = False

    def receive(self, data: bytes, now_s: float) -> None:
        """See `ByteDevice`."""
        self._inbox += data
        while self._inbox:
            size = self._size()
            if len(self._inbox) < size:
                return
            command = bytes(self._inbox[:size])
            del self._inbox[:size]
            self._obey(command, now_s)

    def _size(self) -> int:
        code = self._inbox[0]
        if code in (148, 149):
            return 2 + self._inbox[1] if len(self._inbox) > 1 else 2
        return {142: 2, 150: 2, 137: 5, 145: 5}.get(code, 1)

    def _obey(self, command: bytes, now_s: float) -> None:
        if command[0] == create2.STREAM:
            self._packets, self._is_streaming = [p for p in command[2:] if p in create2.SIZES], True
        elif command[0] == create2.PAUSE_STREAM:
            self._is_streaming = command[1] == 1
        elif command[0] in (142, 149):
            wanted = command[1:2] if command[0] == 142 else command[2:]
            values = self._values(now_s, [p for p in wanted if p in create2.SIZES])
            self._outbox += b"".join(v.to_bytes(create2.SIZES[p], "big") for p, v in values.items())

    def _values(self, time_s: float, packets: list[int]) -> dict[int, int]:
        left, right = self.counting.at(time_s)
        known = {create2.LEFT_ENCODER: left % 65536, create2.RIGHT_ENCODER: right % 65536, 22: 15000, 25: 2500, 26: 2696, 35: 2}
        return {p: known.get(p, 0) for p in packets}

    def emit(self, now_s: float) -> bytes:
        """See `ByteDevice`."""
        out = bytearray(self._outbox)
        self._outbox.clear()
        for time_s in self._times(now_s):
            if self._is_streaming and self._packets:
                out += create2.encode_stream(self._values(time_s, self._packets))
        return bytes(out)


class KobukiSim(_Streaming):
    """Streams core and inertia sub-payloads at 50 Hz from power-up."""

    baud = 115200

    def __init__(self, counting: Counting) -> None:
        super().__init__(counting, 0.02)

    def receive(self, data: bytes, now_s: float) -> None:
        """Commands to drive are not obeyed: the robot explores by itself."""

    def emit(self, now_s: float) -> bytes:
        """See `ByteDevice`."""
        return b"".join(self._frame(time_s) for time_s in self._times(now_s))

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
    """Answers encoder, speed, version and battery reads, and encoder resets; on USB any baud will do."""

    baud = 0

    def __init__(self, counting: Counting, address: int = roboclaw.FIRST_ADDRESS) -> None:
        self.counting, self._address = counting, address
        self._inbox, self._outbox = bytearray(), bytearray()

    def fault(self, kind: str, value: float, now_s: float) -> None:
        """See `Counting.fault`."""
        self.counting.fault(kind, value, now_s)

    def receive(self, data: bytes, now_s: float) -> None:
        """See `ByteDevice`; a partial command is dropped with whatever follows it in the next write."""
        self._inbox[:] = data[-64:]
        while len(self._inbox) >= 2:
            question = bytes(self._inbox[:2])
            if question[0] != self._address:
                del self._inbox[0]
                continue
            used = 4 if question[1] == roboclaw.RESET_ENCODERS else 2
            self._obey(question, now_s)
            del self._inbox[:used]

    def _obey(self, question: bytes, now_s: float) -> None:
        left, right = self.counting.at(now_s)
        if question[1] == roboclaw.RESET_ENCODERS:
            self.counting.fault("encoder-reset", 0, now_s)
            self._outbox += b"\xff"
        elif question[1] == roboclaw.READ_ENCODERS:
            self._outbox += roboclaw.encode_counts(self._address, left, right)
        elif question[1] in (16, 17):
            count = (left if question[1] == 16 else right) % 2**32
            self._outbox += roboclaw.sealed(question, struct.pack(">IB", count, 0))
        elif question[1] == 21:
            self._outbox += roboclaw.sealed(question, b"USB Roboclaw 2x15a v4.1.34\n\0")
        elif question[1] == 24:
            self._outbox += roboclaw.sealed(question, struct.pack(">H", 124))

    def emit(self, now_s: float) -> bytes:
        """See `ByteDevice`."""
        out = bytes(self._outbox)
        self._outbox.clear()
        return out
