"""A simulated RoboClaw: answers every read of the packet serial protocol and takes its writes, by any address and at any baud
as on USB (SERIAL.md 7.4).  Speeds, duties, ways and places turn the wheels, without the time that gaining speed takes.
"""

from __future__ import annotations

import math
import struct
from collections import deque

from hw import roboclaw
from hw.sim.bases_sim import Base, Counting
from hw.sim.roboclaw_tables import (
    BACKWARD,
    DRIVE,
    DUTIES,
    FACTS,
    FORWARD,
    FULL_TICKS_PER_S,
    LEFT,
    MOTOR_1,
    MOTOR_2,
    PLACES,
    RIGHT,
    SIMPLE,
    SPEEDS,
    TURN,
    WAYS,
    WRITES,
    ZEROS,
)

PARTIAL_COMMAND_S = 0.03  # the board's 10 ms, and what a busy computer adds
IDLE = 0x80  # of a buffer of commands


class Motor:
    """What one motor was told: a speed until it is told otherwise, or so many ticks at a speed, one way behind the other."""

    def __init__(self) -> None:
        self.speed = 0.0  # ticks a second
        self.arrives_s = math.inf
        self._ways: deque[tuple[float, int]] = deque()  # speed, ticks

    def run(self, speed: float) -> None:
        """Turn at this speed from now on."""
        self._ways.clear()
        self.speed, self.arrives_s = speed, math.inf

    def go(self, speed: float, ticks: int, is_at_once: bool, now_s: float) -> None:
        """Go so many ticks, at once or behind what is under way."""
        if is_at_once:
            self.run(0.0)
        self._ways.append((speed, ticks))
        if math.isinf(self.arrives_s):
            self.begin_next(now_s)

    def begin_next(self, now_s: float) -> None:
        """It has arrived, or stood: the next way, or rest."""
        self.speed, ticks = self._ways.popleft() if self._ways else (0.0, -1)
        self.arrives_s = math.inf if ticks < 0 else now_s + ticks / max(abs(self.speed), 1e-9) if ticks else now_s

    @property
    def buffer(self) -> int:
        """As the board tells it: how many ways wait, `IDLE` when none is under way."""
        return IDLE if math.isinf(self.arrives_s) else len(self._ways)


class RoboClawSim(Base):
    """`ByteDevice`; motor 1 is the left wheel."""

    baud = 0

    def __init__(self, counting: Counting) -> None:
        super().__init__(counting)
        self._heard_s = 0.0
        self._motors = (Motor(), Motor())
        self._mix = [0.0, 0.0]  # ahead and to the right, ticks a second
        self._last: tuple[float, int, int] | None = None  # time and counters at the last question for speeds

    def receive(self, data: bytes, now_s: float) -> None:
        """See `ByteDevice`; half a command is dropped when the rest does not follow."""
        self._arrive(now_s)
        if now_s - self._heard_s > PARTIAL_COMMAND_S:
            self._inbox.clear()
        self._heard_s = now_s
        self._inbox += data
        while len(self._inbox) >= 2:
            if not roboclaw.FIRST_ADDRESS <= self._inbox[0] <= roboclaw.LAST_ADDRESS:
                del self._inbox[0]
                continue
            n = WRITES.get(self._inbox[1])
            size = 2 if n is None else 4 + n
            if len(self._inbox) < size:
                return
            command = bytes(self._inbox[:size])
            del self._inbox[:size]
            if n is None:
                self._tell(command, now_s)
            elif roboclaw.crc16(command) == 0:
                self._obey(command[1], command[2:-2], now_s)

    def _obey(self, code: int, data: bytes, now_s: float) -> None:
        if code == roboclaw.RESET_ENCODERS:
            self.counting.fault("encoder-reset", 0, now_s)
        elif code in (22, 23):
            self.counting.set(code - 22, struct.unpack(">i", data)[0], now_s)
        elif code in (*SPEEDS, *DUTIES):
            layout, motors = SPEEDS.get(code) or DUTIES[code]
            unit = 1.0 if code in SPEEDS else FULL_TICKS_PER_S / 32767
            self._run(dict(zip(motors, (unit * value for value in struct.unpack(layout, data)), strict=True)), now_s)
        elif code in (*WAYS, *PLACES):
            self._go(code, data, now_s)
        elif code in SIMPLE:
            motor, sign = SIMPLE[code]
            self._run({motor: sign * FULL_TICKS_PER_S * data[0] / 127}, now_s)
        elif code in (6, 7):
            self._run({code - 6: FULL_TICKS_PER_S * (data[0] - 64) / 63}, now_s)
        elif FORWARD <= code <= TURN:
            share = (data[0] - 64) / 63 if code in (DRIVE, TURN) else data[0] / 127 * (-1 if code in (BACKWARD, LEFT) else 1)
            self._mix[code in (RIGHT, LEFT, TURN)] = FULL_TICKS_PER_S * share
            ahead, aside = self._mix
            self._run({MOTOR_1: ahead + aside, MOTOR_2: ahead - aside}, now_s)
        self._outbox += b"\xff"

    def _run(self, ticks_per_s: dict[int, float], now_s: float) -> None:
        for motor, speed in ticks_per_s.items():
            self._motors[motor].run(speed)
        self._drive(now_s)

    def _go(self, code: int, data: bytes, now_s: float) -> None:
        layout, motors = WAYS.get(code) or PLACES[code]
        values = struct.unpack(layout, data)
        for motor, speed, goal in zip(motors, values[0::2], values[1::2], strict=True):
            way = goal if code in WAYS else goal - self.counting.at(now_s)[motor]
            self._motors[motor].go(math.copysign(speed, way) if code in PLACES else speed, abs(way), data[-1] == 1, now_s)
        self._drive(now_s)

    def _drive(self, now_s: float) -> None:
        self.counting.turn_wheels(self._motors[MOTOR_1].speed, self._motors[MOTOR_2].speed, now_s)

    def _arrive(self, now_s: float) -> None:
        """End the ways that are gone by now."""
        while (motor := min(self._motors, key=lambda m: m.arrives_s)).arrives_s <= now_s:
            arrived_s = motor.arrives_s
            motor.begin_next(arrived_s)
            self._drive(arrived_s)

    def emit(self, now_s: float) -> bytes:
        """See `ByteDevice`."""
        self._arrive(now_s)
        return super().emit(now_s)

    def _tell(self, question: bytes, now_s: float) -> None:
        left, right = self.counting.at(now_s)
        counts = {roboclaw.READ_M1: left, roboclaw.READ_M2: right}
        code = question[1]
        if code in counts:
            self._say(question, struct.pack(">IB", counts[code] % 2**32, 0))
        elif code in (18, 19, 30, 31):
            speed = self._speeds(now_s, left, right)[code in (19, 31)]
            self._say(question, struct.pack(">iB", speed, speed < 0))
        elif code in (79, 108):
            self._say(question, struct.pack(">ii", *self._speeds(now_s, left, right)))
        elif code == 73:
            self._say(question, self._status(now_s, left, right))
        elif code == roboclaw.READ_ENCODERS:
            self._say(question, struct.pack(">II", left % 2**32, right % 2**32))
        elif code == 47:
            self._say(question, bytes(motor.buffer for motor in self._motors))
        elif code in FACTS or code in ZEROS:
            self._say(question, FACTS.get(code) or bytes(ZEROS[code]))

    def _status(self, now_s: float, left: int, right: int) -> bytes:
        """Everything at once, as newer boards tell it: counters, speeds, voltages, temperatures."""
        speeds = self._speeds(now_s, left, right)
        head = struct.pack(">2I4H", round(now_s * 1e3) % 2**32, 0, 250, 250, 124, 50)
        body = struct.pack(">4h2I4i4h", 0, 0, 0, 0, left % 2**32, right % 2**32, *speeds, *speeds, 0, 0, 0, 0)
        return head + body

    def _speeds(self, now_s: float, left: int, right: int) -> tuple[int, int]:
        """Ticks a second since the last such question."""
        before_s, before_left, before_right = self._last or (now_s, left, right)
        if now_s - before_s > 0.01 or self._last is None:
            self._last = now_s, left, right
        seconds = max(now_s - before_s, 0.01)
        return round((left - before_left) / seconds), round((right - before_right) / seconds)

    def _say(self, question: bytes, data: bytes) -> None:
        self._outbox += roboclaw.sealed(question, data)
