"""Simulated spinning LIDARs of the simpler families: LDROBOT, YDLIDAR, Neato XV-11 and LDS-01."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hw import ld06, xv11, ydlidar_wire
from hw.rplidar_wire import Descriptor
from hw.sim.sight import Floats, Sight, Turntable, joined, solve_angles, wrap_ms


class LdrobotSim:
    """LD06, LD19 and STL-27L: stream from power-up, take no commands."""

    def __init__(self, model: str, sight: Sight) -> None:
        self._model, self._sight = ld06.MODELS[model], sight
        self.baud = self._model.baud
        beams = 2 * self._model.samples_per_s // 10  # two turns: 450 beams are no whole number of packets, 900 are
        self._head = Turntable.in_frames(5.0, beams, ld06.BEAMS)
        self._clock_offset_s = 0.0

    def fault(self, kind: str, value: float, now_s: float) -> None:
        """Misbehave: `clock` jumps by so many seconds, `shift` of the head in turns."""
        if kind == "clock":
            self._clock_offset_s += value
        elif kind == "shift":
            self._head.shift(value / 2)

    def receive(self, data: bytes, now_s: float) -> None:
        """Nobody listens."""

    def emit(self, now_s: float) -> bytes:
        """See `ByteDevice`: whole packets, each sent when its last beam is measured."""
        if not (parts := self._head.due(now_s)):
            return b""
        index, times_s, _ = joined(parts)
        turn_deg = index * 720.0 / self._head.beams_per_turn % 360.0
        mm = self._sight.distances_mm(times_s, -np.radians(turn_deg), ld06.RANGE_MIN_M, self._model.range_max_m)
        cdeg = np.rint(turn_deg * 100).astype(int) % 36000
        rows = zip(mm.astype(int).reshape(-1, 12).tolist(), cdeg.reshape(-1, 12).tolist(), times_s[11::12].tolist(), strict=True)
        return b"".join(
            ld06.encode(
                ld06.Packet(
                    3600, a[0], a[-1], wrap_ms(t + self._clock_offset_s, 30000), tuple(d), tuple(200 if v else 0 for v in d)
                )
            )
            for d, a, t in rows
        )


@dataclass(frozen=True, slots=True)
class YdlidarUnit:
    """What a model sends."""

    number: int  # model byte
    samples_per_s: int
    turn_hz: float
    sample_bytes: int


OLD_HEALTH, OLD_RESET = 0x91, 0x40  # what hosts written for the first X4 and G4 send
YDLIDARS = {"x2": YdlidarUnit(6, 3000, 6.0, 2), "x4": YdlidarUnit(6, 5000, 8.0, 2), "g2": YdlidarUnit(15, 5000, 10.0, 3)}


class YdlidarSim:
    """X2 (one-way), X4 and G2 (two-way, the G2 with intensity)."""

    def __init__(self, model: str, sight: Sight) -> None:
        self._model, self._unit, self._sight = ydlidar_wire.MODELS[model], YDLIDARS[model], sight
        self.baud = self._model.baud
        self._head = Turntable.in_frames(self._unit.turn_hz, round(self._unit.samples_per_s / self._unit.turn_hz), 40)
        self._is_sending = not self._model.is_two_way
        self._inbox, self._outbox = bytearray(), bytearray()
        self._status = 0

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
            if self._inbox[0] == 0xA5:
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
        elif code in (ydlidar_wire.SCAN, 0x61):
            self._outbox += Descriptor(5, True, ydlidar_wire.SCAN_TYPE).encode()
            self._is_sending = True
            self._head.restart(now_s)

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
        width, hz = self._unit.sample_bytes, self._unit.turn_hz
        intensities = (120,) * len(mm) if width > 2 else ()
        words = tuple(int(4 * v) for v in mm)
        packet = ydlidar_wire.encode(ydlidar_wire.Packet(False, 0.0, int(q6[0]), int(q6[-1]), words, intensities), width)
        if q6[0] > 0:
            return packet
        return ydlidar_wire.encode(ydlidar_wire.Packet(True, hz, 0, 0, (0,), (0,) if width > 2 else ()), width) + packet


class NeatoSim:
    """XV-11 (counter-clockwise, streams when its motor turns) and LDS-01 (clockwise, started with 'b')."""

    def __init__(self, kind: xv11.Kind, sight: Sight) -> None:
        self._kind, self._sight = kind, sight
        self.baud = kind.baud
        self._is_sending = not kind.start
        self._head = Turntable.in_frames(5.0, 360, kind.beams)

    def fault(self, kind: str, value: float, now_s: float) -> None:
        """Misbehave: `shift` of the head in turns."""
        if kind == "shift":
            self._head.shift(value)

    def receive(self, data: bytes, now_s: float) -> None:
        """See `ByteDevice`."""
        for byte in data:
            if self._kind.start and bytes((byte,)) in (self._kind.start, self._kind.stop):
                self._is_sending = bytes((byte,)) == self._kind.start

    def emit(self, now_s: float) -> bytes:
        """See `ByteDevice`."""
        if not self._is_sending or not (parts := self._head.due(now_s)):
            return b""
        index, times_s, cuts = joined(parts)
        is_ccw = self._kind is xv11.XV11
        angles_rad = np.radians(index if is_ccw else 359.0 - index)
        mm = self._sight.distances_mm(times_s, angles_rad, self._kind.range_min_m, self._kind.range_max_m)
        packets = zip(np.split(index, cuts), np.split(mm, cuts), strict=True)
        return b"".join(self._packet(int(i[0]) // self._kind.beams, [int(v) for v in d]) for i, d in packets)

    def _packet(self, index: int, mm: list[int]) -> bytes:
        n = len(mm)
        signals = tuple(200 if v else 0 for v in mm)
        if self._kind is xv11.XV11:
            invalid = tuple(v == 0 for v in mm)
            return xv11.encode_xv11(xv11.Packet(index, 300.0, tuple(mm), signals, (False,) * n, invalid))
        return xv11.encode_lds01(xv11.Packet(index, 300.0, tuple(mm), signals))
