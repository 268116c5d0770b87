"""SICK LMS200, 211, 220, 221, 291: the scanner of most recordings of the paper's time (SERIAL.md 5).

    02 addr len:u16 payload crc:u16        host to scanner at address 00, scanner to host at 80; 06 before an answer: accepted

A scan is a payload `B0 info:u16 value:u16 ... status`: 181 values over 180 degrees, 361 at half a degree, or 101, 201, 401
over 100 degrees, counter-clockwise from the right.  The unit (cm or mm) stands in `info`.  The scanner wakes at 9600 baud;
it is found at whatever rate it has, set to the one asked for, and told to send continuously.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hw.driver import Ask, Drain, DriverBase, Pause, Reading, Script, Send, SetBaud
from hw.errors import DeviceSilent
from hw.framing import ByteWindow, SizedFrames
from hw.readings import LaserScan
from hw.scan_assembler import supported_only
from hw.suspicion import Suspicion

STX, ACK, NAK = 0x02, 0x06, 0x15
ACKS = (bytes((ACK,)), bytes((NAK,)))
HOST_ADDRESS, SCANNER_ADDRESS = 0x00, 0x80
MOST_PAYLOAD = 812
STATUS, ERRORS, TYPE, RESET, MODE, VARIANT = b"\x31", b"\x32", b"\x3a", b"\x10", 0x20, 0x3B
CONTINUOUS, POLLED, PARTIAL = bytes((MODE, 0x24)), bytes((MODE, 0x25)), bytes((MODE, 0x2A))
ONE_SCAN, GET_CONFIG, SET_CONFIG = b"\x30\x01", 0x74, 0x77
MEASURING_MODE_AT, UNIT_AT = 5, 6  # in the configuration
MEASURING_MODE_IN_STATUS = 102
RATE_CODES = {9600: 0x42, 19200: 0x41, 38400: 0x40, 500000: 0x48}
INSTALL = bytes((MODE, 0x00)) + b"SICK_LMS"
FIELDS = {
    101: (100.0, 1.0),
    201: (100.0, 0.5),
    401: (100.0, 0.25),
    181: (180.0, 1.0),
    361: (180.0, 0.5),
}  # values: (degrees, step)
MIRROR_S = 1 / 75  # a turn of the mirror; half- and quarter-degree scans take two and four
RANGE_MIN_M, RANGE_MAX_M = 0.05, 80.0
VALUE_MASKS = dict.fromkeys((0, 1, 2), 0x1FFF) | dict.fromkeys((3, 4), 0x3FFF) | dict.fromkeys((5, 6, 15), 0x7FFF)
CODES = 9  # the highest so many values are no distances: dazzled, out of range, ...
HEAD_BYTES = 4


def crc16(data: bytes | bytearray) -> int:
    """SICK's own: a shift register with 0x8005 that takes two bytes at a time, overlapping."""
    crc = before = 0
    for byte in data:
        crc = (crc & 0x7FFF) << 1 ^ 0x8005 if crc & 0x8000 else crc << 1
        crc ^= before << 8 | byte
        before = byte
    return crc


def encode(payload: bytes, address: int = HOST_ADDRESS) -> bytes:
    """A telegram as it stands on the wire."""
    head = struct.pack("<BBH", STX, address, len(payload)) + payload
    return head + struct.pack("<H", crc16(head))


def decode(telegram: bytes) -> tuple[int, bytes] | None:
    """(address, payload) of these bytes, which must be exactly one telegram; else None."""
    if len(telegram) < 7 or telegram[0] != STX or len(telegram) != 6 + (telegram[2] | telegram[3] << 8):
        return None
    if crc16(telegram[:-2]) != (telegram[-2] | telegram[-1] << 8):
        return None
    return telegram[1], telegram[4:-2]


def variant_request(field_deg: int, step_deg: float) -> bytes:
    """Ask for this field of view (100 or 180) and resolution (0.25, 0.5 or 1)."""
    return struct.pack("<BHH", VARIANT, field_deg, round(step_deg * 100))


@dataclass(frozen=True, slots=True)
class ScanPayload:
    """One scan in the scanner's units."""

    values: tuple[int, ...]
    is_mm: bool = False
    status: int = 0x10
    partial: int | None = None  # one turn of the mirror in steps of a degree, begun so many quarter degrees later

    def encode(self) -> bytes:
        info = len(self.values) | (0x4000 if self.is_mm else 0) | (0 if self.partial is None else 0x2000 | self.partial << 11)
        return struct.pack(f"<BH{len(self.values)}HB", 0xB0, info, *self.values, self.status)

    @staticmethod
    def decode(payload: bytes) -> ScanPayload | None:
        """The scan in this payload, or None when it is something else."""
        if len(payload) < 4 or payload[0] != 0xB0:
            return None
        info = payload[1] | payload[2] << 8
        n = info & 0x3FF
        if n not in FIELDS or len(payload) not in (4 + 2 * n, 5 + 2 * n) or info >> 14 > 1:
            return None  # one byte more: some number their scans
        return ScanPayload(struct.unpack_from(f"<{n}H", payload, 3), info >> 14 == 1, payload[-1])


def ranges_m(scan: ScanPayload, measuring_mode: int | None = None) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Metres; nan where the scanner saw nothing or says why not.

    The measuring mode says how many of the upper bits are field flags (`VALUE_MASKS`), and so where the codes begin: in
    millimetres "nothing" is 8191, 16383 or 32767.  While it is not known, all three are taken for codes.  Centimetres reach
    82 metres in 13 bits, whatever the mode.
    """
    mask = VALUE_MASKS.get(-1 if measuring_mode is None else measuring_mode) if scan.is_mm else 0x1FFF
    value = np.array(scan.values, np.int64) & (mask or 0x7FFF)
    tops = (mask,) if mask else (0x1FFF, 0x3FFF, 0x7FFF)
    is_code = np.any([(value > top - CODES) & (value <= top) for top in tops], axis=0)
    return np.where((value == 0) | is_code, np.nan, value / (1000.0 if scan.is_mm else 100.0))


def _size(data: bytearray) -> int:
    n = data[2] | data[3] << 8
    return 6 + n if 1 <= n <= MOST_PAYLOAD and data[1] == SCANNER_ADDRESS else 0


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
        self._finder = SizedFrames(
            bytes((STX, SCANNER_ADDRESS)), HEAD_BYTES, 6 + MOST_PAYLOAD, _size, lambda f: crc16(f[:-2]) == (f[-2] | f[-1] << 8)
        )
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
        yield Send(encode(POLLED))
        yield Drain(quiet_s=0.1, max_s=0.8)
        self.restart()
        if (yield self._ask(TYPE, 0xBA, 0.5)) is None and (yield self._ask(STATUS, 0xB1, 0.8)) is None:
            raise DeviceSilent(f"no answer at {self.baud} baud; is it a SICK LMS2xx with 24 V, and is the cable crossed?")
        kind = self._answers.get(0xBA, b"")[1:-1].decode("ascii", "replace").strip("\0 ")
        self.identity.model = f"SICK {kind.split(';')[0]}" if kind else "SICK LMS2xx"
        if self.baud != self._rate:
            yield self._ask(bytes((MODE, RATE_CODES[self._rate])), 0xA0, 0.5)  # answered at the old rate
            yield SetBaud(self._rate)
            yield Pause(0.05)
        yield from self._ask_measuring_mode()
        if self._step_deg is not None:
            yield self._ask(variant_request(100 if self._step_deg < 0.5 else 180, self._step_deg), 0xBB, 1.0)
        if (yield self._ask(CONTINUOUS, 0xA0, 1.0)) is None:
            raise DeviceSilent(f"it answers at {self.baud} baud, but will not scan")

    def _ask_measuring_mode(self) -> Script:
        """Its configuration tells it, and its status too."""
        self._measuring_mode = None
        for question, answer, at in (
            (bytes((GET_CONFIG,)), 0xF4, 1 + MEASURING_MODE_AT),
            (STATUS, 0xB1, MEASURING_MODE_IN_STATUS),
        ):
            told = yield self._ask(question, answer, 0.5)
            if told is not None and len(told) > at + 1:
                self._measuring_mode = told[at]
                return

    def stop(self) -> Script:
        """See `Driver.stop`."""
        yield Send(encode(POLLED))

    def _ask(self, payload: bytes, answer: int, timeout_s: float) -> Ask:
        self._answers.pop(answer, None)
        return Ask(encode(payload), lambda: self._answers.get(answer), timeout_s)

    def feed(self, data: bytes, now_s: float) -> list[Reading]:
        """Scans that these bytes complete; answers are kept for the script."""
        self._window.push(data)
        if self._window.data[:1] in ACKS and self._window.data[1:2] in (b"", bytes((STX,))):
            self._window.take(1)  # stands before each answer, outside of its telegram: no damage
        frames = self._finder.take(self._window, self.counters)
        readings: list[Reading] = []
        for row, behind, gap in zip(frames.data, frames.behind.tolist(), frames.gap.tolist(), strict=True):
            readings += self._released(is_followed=gap == 0)
            self._suspicion.note(gap)
            n = int(row[2]) | int(row[3]) << 8
            payload = row[4 : 4 + n].tobytes()
            scan = ScanPayload.decode(payload)
            if scan is None:
                self._answers[payload[0]] = payload
            else:
                self._held = self._scan(scan, now_s - (behind + 6 + n) * 10.0 / self.baud)
        if not self._suspicion or self.counters.gap_bytes or len(self._window) >= HEAD_BYTES:
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

    def _scan(self, scan: ScanPayload, end_s: float) -> LaserScan:
        """The last beam was measured before the telegram began."""
        field_deg, step_deg = FIELDS[len(scan.values)]
        duration_s = MIRROR_S / step_deg * field_deg / 360.0
        metres = ranges_m(scan, self._measuring_mode)
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


def scan_telegram(values: Sequence[int], is_mm: bool = False) -> bytes:
    """A scan as the scanner sends it."""
    return encode(ScanPayload(tuple(values), is_mm).encode(), SCANNER_ADDRESS)
