"""A simulated YDLIDAR, one-way or two-way (SERIAL.md 3): its packets, what it answers, and the speed it is told to turn at."""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np

from hw import ydlidar_wire
from hw.rplidar_wire import Descriptor
from hw.sim.sight import Floats, Sight, Turntable, joined, solve_angles


@dataclass(frozen=True, slots=True)
class YdlidarUnit:
    """What a model sends."""

    number: int  # model byte
    samples_per_s: int
    turn_hz: float
    sample_bytes: int
    rate_code: int = 0  # of its sampling rate, where it has several


SPEED_STEPS_HZ = {0x0D: 0.0, 0x09: 0.1, 0x0A: -0.1, 0x0B: 1.0, 0x0C: -1.0}  # tell the speed aimed at; more, less
LEAST_HZ, MOST_HZ = 5.0, 12.0
GET_RATE, SET_RATE, ZERO_ANGLE = 0xD1, 0xD0, 0x93
# told in one byte: low power, ways to turn, constant speed, exposure, heartbeat; nothing here shows their effect
SWITCHES = {0x01: 1, 0x02: 0, 0x06: 0, 0x07: 1, 0x0E: 1, 0x0F: 0, 0x94: 0, 0x95: 0, 0x96: 1, 0x97: 0, 0xD9: 0}
OLD_HEALTH, OLD_RESET = 0x91, 0x40  # what hosts written for the first X4 and G4 send
YDLIDARS = {"x2": YdlidarUnit(6, 3000, 6.0, 2), "x4": YdlidarUnit(6, 5000, 8.0, 2), "g2": YdlidarUnit(15, 5000, 10.0, 3)}


class YdlidarSim:
    """X2 (one-way), X4 and G2 (two-way, the G2 with intensity)."""

    def __init__(self, model: str, sight: Sight) -> None:
        self._model, self._unit, self._sight = ydlidar_wire.MODELS[model], YDLIDARS[model], sight
        self.baud = self._model.baud
        self._turn_at(self._unit.turn_hz)
        self._is_sending = not self._model.is_two_way
        self._inbox, self._outbox = bytearray(), bytearray()
        self._status = 0

    def _turn_at(self, turn_hz: float) -> None:
        self._turn_hz = turn_hz
        self._head = Turntable.in_frames(turn_hz, round(self._unit.samples_per_s / turn_hz), 40)

    def fault(self, kind: str, value: float, now_s: float) -> None:
        """Misbehave: `health` reports a fault for good, `shift` of the head in turns."""
        if kind == "health":
            self._status = 2
        elif kind == "shift":
            self._head.shift(value)

    def receive(self, data: bytes, now_s: float) -> None:
        """See `ByteDevice`."""
        if not self._model.is_two_way:
            return
        self._inbox += data
        while len(self._inbox) >= 2:
            if self._inbox[0] == 0xA5 != self._inbox[1]:
                self._obey(self._inbox[1], now_s)
                del self._inbox[:2]
            else:
                del self._inbox[0]

    def _obey(self, code: int, now_s: float) -> None:
        if code in (ydlidar_wire.STOP, ydlidar_wire.FORCE_STOP, ydlidar_wire.RESET, OLD_RESET):
            self._is_sending = False
        elif code == ydlidar_wire.INFO:
            body = ydlidar_wire.info_body(self._unit.number, (1, 5), 1, list(range(10)) + [0] * 6)
            self._outbox += ydlidar_wire.answer(ydlidar_wire.INFO_TYPE, body)
        elif code in (ydlidar_wire.HEALTH, OLD_HEALTH):
            self._outbox += ydlidar_wire.answer(ydlidar_wire.HEALTH_TYPE, bytes((self._status, 0, 0)))
        elif code in SPEED_STEPS_HZ:
            aim_hz = round(min(MOST_HZ, max(LEAST_HZ, self._turn_hz + SPEED_STEPS_HZ[code])), 1)
            if aim_hz != self._turn_hz:
                self._turn_at(aim_hz)
            self._tell(struct.pack("<I", round(100 * aim_hz)))
        elif code in (GET_RATE, SET_RATE):
            self._tell(bytes((self._unit.rate_code,)))
        elif code == ZERO_ANGLE:
            self._tell(bytes(4))
        elif code in SWITCHES:
            self._tell(bytes((SWITCHES[code],)))
        elif code in (ydlidar_wire.SCAN, 0x61):
            self._outbox += Descriptor(5, True, ydlidar_wire.SCAN_TYPE).encode()
            if not self._is_sending:  # else it is a host's heartbeat
                self._head.restart(now_s)
            self._is_sending = True

    def _tell(self, body: bytes) -> None:
        """Answer a question about its settings; all are of the type of the device information."""
        self._outbox += ydlidar_wire.answer(ydlidar_wire.INFO_TYPE, body)

    def emit(self, now_s: float) -> bytes:
        """See `ByteDevice`."""
        out = bytes(self._outbox)
        self._outbox.clear()
        if not self._is_sending or not (parts := self._head.due(now_s)):
            return out
        index, times_s, cuts = joined(parts)
        q6 = np.rint(index * 23040 / self._head.beams_per_turn)
        # The host spreads the beams of a packet evenly between its first and last angle.
        turn_deg = np.concatenate([np.linspace(a[0], a[-1], len(a)) for a in np.split(q6, cuts)]) / 64.0
        limits_m = (ydlidar_wire.RANGE_MIN_M, self._model.range_max_m)
        mm = solve_angles(self._sight, times_s, turn_deg, ydlidar_wire.correction_deg, limits_m)
        return out + b"".join(self._packet(a, d) for a, d in zip(np.split(q6, cuts), np.split(mm, cuts), strict=True))

    def _packet(self, q6: Floats, mm: Floats) -> bytes:
        width, hz = self._unit.sample_bytes, self._turn_hz
        intensities = (120,) * len(mm) if width > 2 else ()
        words = tuple(int(4 * v) for v in mm)
        packet = ydlidar_wire.encode(ydlidar_wire.Packet(False, 0.0, int(q6[0]), int(q6[-1]), words, intensities), width)
        if q6[0] > 0:
            return packet
        return ydlidar_wire.encode(ydlidar_wire.Packet(True, hz, 0, 0, (0,), (0,) if width > 2 else ()), width) + packet
