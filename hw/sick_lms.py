"""SICK LMS200, 211, 220, 221, 291: the scanner of most recordings of the paper's time; its telegrams are in `sick_wire`.

It wakes at 9600 baud; it is found at whatever rate it has, set to the one asked for, and told to send continuously.
"""

from __future__ import annotations

import numpy as np

from hw import sick_wire as wire
from hw.byte_window import ByteWindow
from hw.driver import Ask, Drain, DriverBase, Pause, Reading, Script, Send, SetBaud
from hw.errors import DeviceSilent
from hw.framing import SizedFrames
from hw.readings import LaserScan
from hw.scan_assembler import supported_only
from hw.suspicion import Suspicion

RANGE_MIN_M, RANGE_MAX_M = 0.05, 80.0


def _size(data: bytearray) -> int:
    n = data[2] | data[3] << 8
    return 6 + n if 1 <= n <= wire.MOST_PAYLOAD and data[1] == wire.SCANNER_ADDRESS else 0


class SickLms(DriverBase):
    """Driver of the family.  `rate`: the baud to work at; `step_deg`: the resolution, None as it is."""

    def __init__(self, rate: int = 38400, step_deg: float | None = None) -> None:
        super().__init__()
        self.identity.model = "SICK LMS2xx"
        self.bauds = (rate, *(baud for baud in (9600, 38400, 19200, 500000) if baud != rate))
        self.baud = rate
        self.period_s = 0.2
        self.coverage = 0.0
        self.range_min_m, self.range_max_m = RANGE_MIN_M, RANGE_MAX_M
        self._rate, self._step_deg = rate, step_deg
        self._window = ByteWindow(self.counters)
        header = bytes((wire.STX, wire.SCANNER_ADDRESS))
        self._finder = SizedFrames(header, wire.HEAD_BYTES, 6 + wire.MOST_PAYLOAD, _size, wire.is_whole)
        self._answers: dict[int, bytes] = {}
        self._measuring_mode: int | None = None  # not known
        self._last_scan_s: float | None = None
        self._suspicion = Suspicion()
        self._held: LaserScan | None = None  # on a line that is not clean, until the next telegram begins

    def limit(self, range_min_m: float, range_max_m: float) -> None:
        """Believe only ranges within these limits."""
        self.range_min_m, self.range_max_m = range_min_m, range_max_m

    def restart(self) -> None:
        """See `Driver.restart`."""
        self._window.clear()
        self._answers.clear()
        self._last_scan_s, self._held = None, None

    def start(self) -> Script:
        """Stop sending, are you there, the rate, the resolution, send."""
        yield Send(wire.encode(wire.POLLED))
        yield Drain(quiet_s=0.1, max_s=0.8)
        self.restart()
        if (yield self._ask(wire.TYPE, 0xBA, 0.5)) is None and (yield self._ask(wire.STATUS, 0xB1, 0.8)) is None:
            raise DeviceSilent(f"no answer at {self.baud} baud; is it a SICK LMS2xx with 24 V, and is the cable crossed?")
        kind = self._answers.get(0xBA, b"")[1:-1].decode("ascii", "replace").strip("\0 ")
        self.identity.model = f"SICK {kind.split(';')[0]}" if kind else "SICK LMS2xx"
        if self.baud != self._rate:
            yield self._ask(bytes((wire.MODE, wire.RATE_CODES[self._rate])), 0xA0, 0.5)  # answered at the old rate
            yield SetBaud(self._rate)
            yield Pause(0.05)
        yield from self._ask_measuring_mode()
        if self._step_deg is not None:
            yield self._ask(wire.variant_request(100 if self._step_deg < 0.5 else 180, self._step_deg), 0xBB, 1.0)
        if (yield self._ask(wire.CONTINUOUS, 0xA0, 1.0)) is None:
            raise DeviceSilent(f"it answers at {self.baud} baud, but will not scan")

    def _ask_measuring_mode(self) -> Script:
        """Its configuration tells it, and its status too."""
        self._measuring_mode = None
        for question, answer, at in (
            (bytes((wire.GET_CONFIG,)), 0xF4, 1 + wire.MEASURING_MODE_AT),
            (wire.STATUS, 0xB1, wire.MEASURING_MODE_IN_STATUS),
        ):
            told = yield self._ask(question, answer, 0.5)
            if told is not None and len(told) > at + 1:
                self._measuring_mode = told[at]
                return

    def stop(self) -> Script:
        """See `Driver.stop`."""
        yield Send(wire.encode(wire.POLLED))

    def _ask(self, payload: bytes, answer: int, timeout_s: float) -> Ask:
        self._answers.pop(answer, None)
        return Ask(wire.encode(payload), lambda: self._answers.get(answer), timeout_s)

    def feed(self, data: bytes, now_s: float) -> list[Reading]:
        """Scans that these bytes complete; answers are kept for the script."""
        self._window.push(data)
        if self._window.data[:1] in wire.ACKS and self._window.data[1:2] in (b"", bytes((wire.STX,))):
            self._window.take(1)  # stands before each answer, outside of its telegram: no damage
        frames = self._finder.take(self._window, self.counters)
        readings: list[Reading] = []
        for row, behind, gap in zip(frames.data, frames.behind.tolist(), frames.gap.tolist(), strict=True):
            readings += self._released(is_followed=gap == 0)
            self._suspicion.note(gap)
            n = int(row[2]) | int(row[3]) << 8
            payload = row[4 : 4 + n].tobytes()
            scan = wire.ScanPayload.decode(payload)
            if scan is None:
                self._answers[payload[0]] = payload
            else:
                self._held = self._scan(scan, now_s - (behind + 6 + n) * 10.0 / self.baud)
        if not self._suspicion or self.counters.gap_bytes or len(self._window) >= wire.HEAD_BYTES:
            readings += self._released(is_followed=not self.counters.gap_bytes)
        return readings

    def _released(self, is_followed: bool) -> list[Reading]:
        """The scan that waits, when the next telegram begins right behind it: one that lost bytes has eaten of the next."""
        scan, self._held = self._held, None
        if scan is None:
            return []
        if self._suspicion and not is_followed:
            self.counters.rejected += 1
            return []
        return [scan]

    def _scan(self, scan: wire.ScanPayload, end_s: float) -> LaserScan:
        """The last beam was measured before the telegram began."""
        field_deg, step_deg = wire.FIELDS[len(scan.values)]
        duration_s = wire.MIRROR_S / step_deg * field_deg / 360.0
        metres = wire.ranges_m(scan, self._measuring_mode)
        with np.errstate(invalid="ignore"):
            metres = np.where((metres < self.range_min_m) | (metres > self.range_max_m), np.nan, metres)
        if self._suspicion:
            metres = supported_only(metres)
        if self._last_scan_s is not None and 0.005 < end_s - self._last_scan_s < 2.0:
            self.period_s = 0.8 * self.period_s + 0.2 * (end_s - self._last_scan_s)
        self._last_scan_s = end_s
        self.coverage = 1.0
        n = len(scan.values)
        return LaserScan(
            stamp_s=end_s - duration_s,
            ranges_m=metres.astype(np.float32),
            angles_rad=np.radians(np.arange(n) * step_deg - field_deg / 2).astype(np.float32),
            range_min_m=self.range_min_m,
            range_max_m=self.range_max_m,
            duration_s=duration_s,
            time_offsets_s=np.linspace(0.0, duration_s, n, dtype=np.float32),
        )
