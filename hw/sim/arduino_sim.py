"""A simulated ros_arduino_bridge: every command of its sketch, one line at a time (SERIAL.md 7.3)."""

from __future__ import annotations

from hw import arduino_bridge
from hw.sim.bases_sim import Base, Counting

PID_HZ = 30.0
AUTO_STOP_S = 2.0  # without a new command the motors stop
FULL_TICKS_PER_S = 3000.0  # at a raw PWM of 255
OK, INVALID = b"OK\r\n", b"Invalid Command\r\n"
READINGS = {
    b"a": b"512\r\n",
    b"d": b"0\r\n",
    b"p": b"100\r\n",
    b"t": b"90\r\n",
}  # a pin, a pin, a sonar in cm, a servo in degrees
OBEYED = b"cwxsujvyz"  # pins, servos and gains: nothing here shows their effect


class ArduinoBridgeSim(Base):
    """`ByteDevice`."""

    baud = 57600

    def __init__(self, counting: Counting) -> None:
        super().__init__(counting)
        self._stops_s: float | None = None

    def receive(self, data: bytes, now_s: float) -> None:
        """See `ByteDevice`."""
        self._inbox += data
        *lines, tail = bytes(self._inbox[-256:]).split(b"\r")
        self._inbox[:] = tail
        for line in lines:
            self._outbox += self._answer(line.split(), now_s)

    def _answer(self, words: list[bytes], now_s: float) -> bytes:
        code = words[0][-1:] if words else b""  # of a longer word the sketch keeps the last letter
        if code == b"e":
            return arduino_bridge.encode_counts(*self.counting.at(now_s))
        if code == b"b":
            return b"%d\r\n" % self.baud
        if code == b"r":
            self.counting.fault("encoder-reset", 0, now_s)
            return OK
        if code in (b"m", b"o") and code:
            self._drive(PID_HZ if code == b"m" else FULL_TICKS_PER_S / 255.0, words[1:], now_s)
            return OK
        return READINGS.get(code, OK if code and code in OBEYED else INVALID)

    def _drive(self, unit_ticks_per_s: float, speeds: list[bytes], now_s: float) -> None:
        left, right = (unit_ticks_per_s * _number(speeds[k] if len(speeds) > k else b"") for k in (0, 1))
        self.counting.turn_wheels(left, right, now_s)
        self._stops_s = now_s + AUTO_STOP_S if left or right else None

    def emit(self, now_s: float) -> bytes:
        """See `ByteDevice`."""
        if self._stops_s is not None and now_s > self._stops_s:
            self.counting.turn_wheels(0, 0, self._stops_s)
            self._stops_s = None
        return super().emit(now_s)


def _number(word: bytes) -> int:
    """As C's atoi: 0 when it is none."""
    digits = word[1:] if word[:1] in (b"-", b"+") else word
    return int(word) if digits.isdigit() else 0
