"""A simulated iRobot Create 2: its Open Interface as far as a host can tell it from the real one (SERIAL.md 7.1).

Every command is understood by its length, every sensor packet and group has its size and a plausible value; the wheel
counters are those of whatever turns the wheels.  It starts in the off mode, as after power-up, and hears only START and RESET;
in the safe and full modes it drives as it is told.
"""

from __future__ import annotations

import math
import struct

from hw import create2
from hw.sim.bases_sim import Counting, Streaming

OFF, PASSIVE, SAFE, FULL = range(4)
_MODES = {create2.START: PASSIVE, 130: SAFE, create2.SAFE: SAFE, 132: FULL, 143: PASSIVE, 173: OFF}
_MODES |= dict.fromkeys((133, 134, 135, 136), PASSIVE)  # power off and the ways to clean
_RESET, _QUERY, _QUERY_LIST, _SONG = 7, 142, 149, 140
_LENGTHS = {129: 2, 137: 5, 138: 2, 139: 4, 141: 2, 142: 2, 144: 4, 145: 5, 146: 5, 150: 2, 162: 3, 163: 5, 164: 5, 165: 2}
_LENGTHS |= {167: 16, 168: 4}  # of a command with its operands; those not here are one byte long
_VALUES = {22: 15000, 23: -250, 24: 25, 25: 2500, 26: 2696, 34: 0, 58: 2}  # mV, mA, degrees, mAh, mAh, sources, stasis
_DRIVE, _DRIVE_DIRECT, _DRIVE_PWM = 137, 145, 146
_START_BAUD, _BAUD = 115200, 129
_RATES = (300, 600, 1200, 2400, 4800, 9600, 14400, 19200, 28800, 38400, 57600, 115200)
_DISTANCE, _ANGLE = 19, 20  # each since it was last told
_SPEED_TOLD, _RADIUS_TOLD, _RIGHT_TOLD, _LEFT_TOLD = 39, 40, 41, 42
_FULL_MM_S = 500.0  # at a PWM of 255
ANSWER_S = 0.008  # of the 15 ms it may take; some hosts clear their input right after they have asked
_BOOT = ((0.0, b"Soft reset!\n"), (1.0, b"\xfe"), (3.0, b"Roomba by iRobot!\r\nstm32\r\n"))  # seconds after RESET


class Create2Sim(Streaming):
    """`ByteDevice`."""

    def __init__(self, counting: Counting) -> None:
        super().__init__(counting, 0.015)
        self.baud = _START_BAUD
        self._mode = OFF
        self._wishes: dict[int, int] = {}  # the last command to drive, as the packets 39 to 42 tell it
        self._told = {_DISTANCE: 0, _ANGLE: 0}  # mm and degrees, until the last answer
        self._stream: list[int] = []
        self._is_streaming = False
        self._said: list[tuple[float, bytes]] = []  # when, and what
        self._booted_s = -math.inf

    def receive(self, data: bytes, now_s: float) -> None:
        """See `ByteDevice`."""
        self._inbox += data
        while self._inbox and len(self._inbox) >= (size := self._size()):
            command = bytes(self._inbox[:size])
            del self._inbox[:size]
            if now_s >= self._booted_s and (self._mode != OFF or command[0] in (create2.START, _RESET)):
                self._obey(command, now_s)

    def _size(self) -> int:
        """Of the command at the front, as far as its first bytes tell."""
        code, n = self._inbox[0], len(self._inbox)
        if code in (create2.STREAM, _QUERY_LIST):
            return 2 + self._inbox[1] if n > 1 else 2
        if code == _SONG:
            return 3 + 2 * self._inbox[2] if n > 2 else 3
        return _LENGTHS.get(code, 1)

    def _obey(self, command: bytes, now_s: float) -> None:
        code = command[0]
        self._mode = _MODES.get(code, self._mode)
        if code in _MODES and self._mode in (OFF, PASSIVE):
            self._wishes = {}
            self._drive(0, 0, now_s)
        if code == create2.STREAM:
            self._stream = [p for p in command[2:] if p in create2.SIZES or p in create2.GROUPS]
            self._is_streaming = True
        elif code == create2.PAUSE_STREAM:
            self._is_streaming = command[1] == 1
        elif code in (_QUERY, _QUERY_LIST):
            asked = command[1:] if code == _QUERY else command[2:]
            self._said.append((now_s + ANSWER_S, self._answer(asked, now_s)))
        elif code == _BAUD:
            self.baud = _RATES[command[1]] if command[1] < len(_RATES) else self.baud
        elif code == _RESET:
            self.baud = _START_BAUD
            self._mode, self._is_streaming = OFF, False
            self._drive(0, 0, now_s)
            self._said = [(now_s + later_s, text) for later_s, text in _BOOT]
            self._booted_s = self._said[-1][0]
        elif code == 173:
            self._is_streaming = False
        elif code in (_DRIVE, _DRIVE_DIRECT, _DRIVE_PWM) and self._mode in (SAFE, FULL):
            first, second = struct.unpack(">hh", command[1:])
            self._wishes = (
                {_SPEED_TOLD: first, _RADIUS_TOLD: second} if code == _DRIVE else {_RIGHT_TOLD: first, _LEFT_TOLD: second}
            )
            self._drive(*_wheels_mm_s(code, first, second), now_s)

    def _drive(self, left_mm_s: float, right_mm_s: float, now_s: float) -> None:
        ticks_per_mm = 1e-3 / create2.METRES_PER_TICK
        self.counting.turn_wheels(left_mm_s * ticks_per_mm, right_mm_s * ticks_per_mm, now_s)

    def _answer(self, asked: bytes, now_s: float) -> bytes:
        packets = [p for a in asked for p in create2.GROUPS.get(a, (a,)) if p in create2.SIZES]
        values = self._values(now_s, packets)
        return b"".join(create2.encode_value(p, values[p]) for p in packets)

    def _values(self, time_s: float, packets: list[int]) -> dict[int, int]:
        left, right = self.counting.at(time_s)
        known = {
            **_VALUES,
            **self._wishes,
            **self._since_told(packets, left, right),
            create2.LEFT_ENCODER: left,
            create2.RIGHT_ENCODER: right,
            35: self._mode,
            38: len(self._stream),
        }
        return {p: known.get(p, 0) for p in packets}

    def _since_told(self, packets: list[int], left: int, right: int) -> dict[int, int]:
        """Way and turn since each was asked for."""
        way_mm = 1e3 * create2.METRES_PER_TICK * (left + right) / 2
        turn_deg = math.degrees(create2.METRES_PER_TICK * (right - left) / create2.TRACK_M)
        now = {packet: value for packet, value in ((_DISTANCE, round(way_mm)), (_ANGLE, round(turn_deg))) if packet in packets}
        since = {packet: value - self._told[packet] for packet, value in now.items()}
        self._told |= now
        return since

    def emit(self, now_s: float) -> bytes:
        """See `ByteDevice`."""
        out = bytearray().join(text for due_s, text in self._said if due_s <= now_s)
        self._said = [(due_s, text) for due_s, text in self._said if due_s > now_s]
        for time_s in self.times(now_s):
            if self._is_streaming and self._stream:
                packets = (bytes((p,)) for p in self._stream)
                out += create2.framed(b"".join(p + self._answer(p, time_s) for p in packets))
        return bytes(out)


def _wheels_mm_s(code: int, first: int, second: int) -> tuple[float, float]:
    """Left and right, of the operands of a command to drive."""
    if code == _DRIVE_DIRECT:
        return second, first
    if code == _DRIVE_PWM:
        return second * _FULL_MM_S / 255, first * _FULL_MM_S / 255
    if second in (-32768, 32767, 0):
        return first, first
    if abs(second) == 1:
        return -first * second, first * second
    half_mm = 1e3 * create2.TRACK_M / 2
    return first * (1 - half_mm / second), first * (1 + half_mm / second)
