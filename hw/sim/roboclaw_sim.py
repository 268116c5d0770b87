"""A simulated RoboClaw: answers every read of the packet serial protocol and takes its writes, by any address and at any baud
as on USB (SERIAL.md 7.4).  Speeds and duties turn the wheels; positions and distances are taken, and not driven.
"""

from __future__ import annotations

import struct

from hw import roboclaw
from hw.sim.bases_sim import Base, Counting

PARTIAL_COMMAND_S = 0.03  # the board's 10 ms, and what a busy computer adds
FULL_TICKS_PER_S = 5000.0  # at full duty
MOTOR_1, MOTOR_2 = 0, 1
FACTS = {  # what does not change while it is looked at
    15: b"\0",  # serial timeout
    roboclaw.READ_VERSION: b"USB Roboclaw 2x15a v4.1.34\n\0",
    roboclaw.READ_MAIN_BATTERY: struct.pack(">H", 124),  # tenths of a volt
    25: struct.pack(">H", 50),
    47: b"\x80\x80",  # both command buffers are empty
    55: struct.pack(">4I", 0x10000, 0x8000, 0x4000, round(FULL_TICKS_PER_S)),
    56: struct.pack(">4I", 0x10000, 0x8000, 0x4000, round(FULL_TICKS_PER_S)),
    59: struct.pack(">2HB", 60, 340, 0),
    60: struct.pack(">2H", 55, 340),
    82: struct.pack(">H", 250),  # tenths of a degree
    83: struct.pack(">H", 250),
    100: struct.pack(">2H", 124, 50),
    101: struct.pack(">2H", 250, 250),
    135: struct.pack(">2I", 1500, 0),  # hundredths of an ampere
    136: struct.pack(">2I", 1500, 0),
}
ZEROS = {97: 37, 48: 4, 49: 4, 63: 28, 64: 28, 72: 4, 75: 5, 77: 24, 81: 16, 90: 4, 91: 2, 99: 2, 103: 2, 104: 10, 107: 8}
ZEROS |= {
    110: 4,
    111: 4,
    113: 4,
    114: 4,
    116: 2,
    130: 8,
    131: 8,
    138: 1,
    140: 3,
    142: 2,
    144: 1,
    146: 1,
    147: 1,
    149: 2,
    151: 1,
    161: 2,
}  # reads: bytes of zeros
WRITES = (
    dict.fromkeys((*range(15), 92, 93, 150), 1)
    | {96: 37, 143: 53, 145: 10}
    | {20: 0, 95: 0, 22: 4, 23: 4, 28: 16, 29: 16, 32: 2, 33: 2, 34: 4, 35: 4}
)
WRITES |= {36: 4, 37: 8, 38: 8, 39: 8, 40: 12, 41: 9, 42: 9, 43: 17, 44: 13, 45: 13, 46: 21, 50: 16, 51: 25, 52: 6, 53: 6, 54: 12}
WRITES |= {57: 5, 58: 4, 61: 28, 62: 28, 65: 17, 66: 17, 67: 33, 68: 8, 69: 8, 70: 2, 71: 2, 74: 5, 76: 24, 80: 4, 94: 4, 98: 2}
WRITES |= {102: 10, 105: 4, 106: 4, 109: 4, 112: 4, 115: 2, 119: 5, 120: 5, 121: 9, 122: 9, 123: 9, 124: 17, 125: 3, 126: 3}
WRITES |= {
    127: 5,
    128: 8,
    129: 8,
    133: 8,
    134: 8,
    137: 2,
    139: 3,
    141: 2,
    148: 2,
    160: 2,
    200: 0,
    248: 0,
    249: 0,
}  # bytes of data
SPEEDS = {35: (">i", (MOTOR_1,)), 36: (">i", (MOTOR_2,)), 37: (">ii", (MOTOR_1, MOTOR_2))}
SPEEDS |= {
    38: (">4xi", (MOTOR_1,)),
    39: (">4xi", (MOTOR_2,)),
    40: (">4xii", (MOTOR_1, MOTOR_2)),
    50: (">4xi4xi", (MOTOR_1, MOTOR_2)),
}
DUTIES = {32: (">h", (MOTOR_1,)), 33: (">h", (MOTOR_2,)), 34: (">hh", (MOTOR_1, MOTOR_2))}
DUTIES |= {52: (">h4x", (MOTOR_1,)), 53: (">h4x", (MOTOR_2,)), 54: (">h4xh4x", (MOTOR_1, MOTOR_2))}
SIMPLE = {0: (MOTOR_1, 1), 1: (MOTOR_1, -1), 4: (MOTOR_2, 1), 5: (MOTOR_2, -1)}  # of 127: forward, backward


class RoboClawSim(Base):
    """`ByteDevice`; motor 1 is the left wheel."""

    baud = 0

    def __init__(self, counting: Counting) -> None:
        super().__init__(counting)
        self._heard_s = 0.0
        self._turning = [0.0, 0.0]  # as told, ticks a second
        self._last: tuple[float, int, int] | None = None  # time and counters at the last question for speeds

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
        elif code in SPEEDS or code in DUTIES:
            layout, motors = SPEEDS.get(code) or DUTIES[code]
            unit = 1.0 if code in SPEEDS else FULL_TICKS_PER_S / 32767
            self._turn(dict(zip(motors, (unit * value for value in struct.unpack(layout, data)), strict=True)), now_s)
        elif code in SIMPLE:
            motor, sign = SIMPLE[code]
            self._turn({motor: sign * FULL_TICKS_PER_S * data[0] / 127}, now_s)
        elif code in (6, 7):
            self._turn({code - 6: FULL_TICKS_PER_S * (data[0] - 64) / 63}, now_s)
        self._outbox += b"\xff"

    def _turn(self, ticks_per_s: dict[int, float], now_s: float) -> None:
        for motor, speed in ticks_per_s.items():
            self._turning[motor] = speed
        self.counting.turn_wheels(self._turning[MOTOR_1], self._turning[MOTOR_2], now_s)

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
