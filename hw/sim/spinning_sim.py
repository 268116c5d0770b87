"""Simulated spinning LIDARs that know no questions: LDROBOT, Neato XV-11 and LDS-01."""

from __future__ import annotations

import numpy as np

from hw import ld06, xv11
from hw.sim.sight import Sight, Turntable, joined, wrap_ms


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
