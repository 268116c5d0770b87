"""A simulated SICK LMS291."""

from __future__ import annotations

import numpy as np

from hw import sick_lms
from hw.sim.devices import SickScanner
from hw.sim.sight import Sight


class SickSim(SickScanner):
    """A SICK LMS291 that wakes at 9600 baud, in centimetres or millimetres, 180 or 100 degrees."""

    def __init__(self, sight: Sight) -> None:
        super().__init__(_Nothing())
        self.baud = 9600
        self._sight = sight
        self._field_deg, self._step_deg, self._is_mm = 180.0, 0.5, True
        self._next_s: float | None = None

    def _answer(self, payload: bytes) -> bytes:
        if payload[0] == sick_lms.VARIANT and len(payload) == 5:
            self._field_deg, self._step_deg = float(payload[1]), (payload[3] | payload[4] << 8) / 100.0
        if payload[0] == 0x74:
            return b"\xf4" + self._config() + b"\x10"
        if payload[0] == 0x77 and len(payload) > 7:
            self._is_mm = payload[7] == 1
            return b"\xf7\x01" + payload[1:] + b"\x10"
        return super()._answer(payload)

    def _config(self) -> bytes:
        """The 32 bytes of the configuration; the sixth is the measuring mode, the seventh the unit."""
        return bytes((0, 0, 70, 0, 0, 6 if self._is_mm else 0, 1 if self._is_mm else 0)) + bytes(25)

    def emit(self, now_s: float) -> bytes:
        """See `ByteDevice`: as many scans as the line carries."""
        out = super().emit(now_s)
        if not self._is_sending:
            self._next_s = None
            return out
        n = round(self._field_deg / self._step_deg) + 1
        period_s = max(sick_lms.MIRROR_S / self._step_deg, (10 + 2 * n) * 10.0 / self.baud)
        if self._next_s is None or now_s - self._next_s > 0.5:
            self._next_s = now_s + period_s
        while self._next_s <= now_s:
            out += self._telegram(n, self._next_s - (10 + 2 * n) * 10.0 / self.baud)
            self._next_s += period_s
        return out

    def _telegram(self, n: int, end_s: float) -> bytes:
        duration_s = sick_lms.MIRROR_S / self._step_deg * self._field_deg / 360.0
        angles_rad = np.radians(np.arange(n) * self._step_deg - self._field_deg / 2)
        times_s = np.linspace(end_s - duration_s, end_s, n)
        far_m, nothing, scale = (32.0, 0x7FFF, 1e3) if self._is_mm else (80.0, 0x1FFF, 1e2)
        ranges_m = self._sight.ranges_m(times_s, angles_rad, 0.05, far_m)
        values = np.where(np.isfinite(ranges_m), np.rint(np.where(np.isfinite(ranges_m), ranges_m, 0) * scale), nothing)
        return sick_lms.scan_telegram([int(v) for v in values], self._is_mm)


class _Nothing:
    def scans_until(self, now_s: float) -> list[list[int]]:
        """See `ScanSource`."""
        return []
