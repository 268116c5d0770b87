"""A simulated SICK LMS291, as far as its hosts ask: status, type, configuration, variants, reset, and scans streamed or polled,
whole, in parts, in part, or as means (SERIAL.md 5).
"""

from __future__ import annotations

import struct
from dataclasses import replace

import numpy as np

from hw import sick_wire
from hw.sim.devices import SICK_TYPE, SickScanner
from hw.sim.sight import Sight

VERSION = b"V02.10 "
OK, FAILED = b"\xa0\x00\x10", b"\xa0\x02\x10"
INSTALLATION = 0x00
MEANS, SECTOR = 0x26, 0x27  # ways of sending: means of so many scans; values of each scan from one to another
WAYS = {sick_wire.CONTINUOUS[1]: 0, sick_wire.POLLED[1]: 0, sick_wire.PARTIAL[1]: 0, MEANS: 1, SECTOR: 4}  # bytes of operands
ASK_MEANS, ASK_SECTOR = 0x36, 0x37
VARIANTS = {(100, 100), (100, 50), (100, 25), (180, 100), (180, 50)}  # degrees, hundredths of a degree between beams
RATE_WORDS = {9600: 0x8067, 19200: 0x8033, 38400: 0x8019, 500000: 0x8001}
BOOT_S = 1.0
UNIT_AT, MEASURING_MODE_AT = sick_wire.UNIT_AT, sick_wire.MEASURING_MODE_AT
RANGE_32_M = 6  # a measuring mode; in the others, in millimetres, it reaches 8 metres
CONFIG = bytes((0, 0, 70, 0, 0, RANGE_32_M, 1)) + bytes(27)
STATUS_BYTES = 152


class SickSim(SickScanner):
    """Wakes at 9600 baud, half a degree over 180, in millimetres."""

    def __init__(self, sight: Sight) -> None:
        super().__init__(_Nothing())
        self.baud = 9600
        self._sight = sight
        self._field_deg, self._step_deg = 180, 0.5
        self._config = CONFIG
        self._mode, self._operands = sick_wire.POLLED[1], b""
        self._booted_s = 0.0
        self._is_booting = False
        self._turn = 0  # of the mirror, while scans are sent in parts
        self._now_s = 0.0
        self._next_s: float | None = None

    def _answer(self, payload: bytes) -> bytes:
        if payload[0] == sick_wire.MODE and len(payload) > 1:
            return self._change_mode(payload)
        if payload == sick_wire.RESET:
            return self._reset()
        if payload[0] == sick_wire.VARIANT and len(payload) == 5:
            wish = struct.unpack("<HH", payload[1:])
            if wish in VARIANTS:
                self._field_deg, self._step_deg = wish[0], wish[1] / 100.0
            return b"\xbb" + struct.pack("<BHH", wish in VARIANTS, self._field_deg, round(100 * self._step_deg)) + b"\x10"
        if payload == sick_wire.ONE_SCAN:
            return self._whole(self._now_s).encode()
        if payload[0] == ASK_MEANS and len(payload) == 2:
            return _means(self._whole(self._now_s), payload[1:])
        if payload[0] == ASK_SECTOR and len(payload) == 5:
            return _sector(self._whole(self._now_s), payload[1:])
        if payload == sick_wire.STATUS:
            return b"\xb1" + self._status() + b"\x10"
        if payload[0] == sick_wire.GET_CONFIG:
            return b"\xf4" + self._config + b"\x10"
        if payload[0] == sick_wire.SET_CONFIG:
            is_taken = self._mode == INSTALLATION and len(payload) > UNIT_AT + 1
            self._config = payload[1:].ljust(len(CONFIG), b"\0")[: len(CONFIG)] if is_taken else self._config
            return b"\xf7" + bytes((is_taken,)) + self._config + b"\x10"
        return super()._answer(payload)

    def _change_mode(self, payload: bytes) -> bytes:
        """To a baud rate, to a way of sending scans, or to be set up, which takes a password."""
        if payload[1] in sick_wire.RATE_CODES.values():
            return super()._answer(payload)
        if payload[1] == INSTALLATION:
            is_known = payload == sick_wire.INSTALL
            self._mode, self._is_sending = (INSTALLATION, False) if is_known else (self._mode, self._is_sending)
            return OK if is_known else b"\xa0\x01\x10"
        if len(payload) != 2 + WAYS.get(payload[1], -9):
            return FAILED
        self._mode, self._operands, self._turn = payload[1], payload[2:], 0
        self._is_sending = payload != sick_wire.POLLED
        return OK

    def _reset(self) -> bytes:
        """As after power-up: at 9600 baud from the answer on, and silent until it has booted."""
        self._mode, self._is_sending, self.baud = sick_wire.POLLED[1], False, 9600
        self._booted_s, self._is_booting = self._now_s + BOOT_S, True
        return b"\x91\x10"

    def _status(self) -> bytes:
        """What is told of it, at the places the manual gives, counted behind the B1."""
        told = bytearray(STATUS_BYTES)
        told[0:7] = VERSION
        told[7] = self._mode
        struct.pack_into("<H", told, 66, 4500)  # turns of the mirror a minute
        told[sick_wire.MEASURING_MODE_IN_STATUS - 1] = self._config[MEASURING_MODE_AT]
        struct.pack_into("<HH", told, 106, self._field_deg, round(100 * self._step_deg))
        struct.pack_into("<H", told, 115, RATE_WORDS[self.baud])
        told[121], told[122] = self._config[UNIT_AT], 1  # unit, laser
        told[123:130] = VERSION
        return bytes(told)

    def receive(self, data: bytes, now_s: float) -> None:
        """See `ByteDevice`; while it boots it is deaf."""
        if now_s < self._booted_s:
            return
        self._now_s = now_s
        super().receive(data, now_s)

    def emit(self, now_s: float) -> bytes:
        """See `ByteDevice`: as many scans as the line carries."""
        out = super().emit(now_s)
        if self._is_booting and now_s >= self._booted_s:
            self._is_booting = False
            out += sick_wire.encode(b"\x90" + SICK_TYPE + b"\x10", sick_wire.SCANNER_ADDRESS)
        if not self._is_sending:
            self._next_s = None
            return out
        step_deg = 1.0 if self._mode == sick_wire.PARTIAL[1] else self._step_deg
        line_s = (10 + 2 * (self._field_deg / step_deg + 1)) * 10.0 / self.baud
        turns = self._operands[0] if self._mode == MEANS else 1
        period_s = max(turns * sick_wire.MIRROR_S / step_deg, line_s)
        if self._next_s is None or now_s - self._next_s > 0.5 + period_s:
            self._next_s = now_s + period_s
        while self._next_s <= now_s:
            out += sick_wire.encode(self._sent(self._next_s - line_s), sick_wire.SCANNER_ADDRESS)
            self._next_s += period_s
        return out

    def _sent(self, end_s: float) -> bytes:
        """What is sent of a scan that ends then, in the way that was asked for."""
        if self._mode == sick_wire.PARTIAL[1]:
            return self._part(end_s).encode()
        if self._mode == MEANS:
            return _means(self._whole(end_s), self._operands)
        if self._mode == SECTOR:
            return _sector(self._whole(end_s), self._operands)
        return self._whole(end_s).encode()

    def _whole(self, end_s: float) -> sick_wire.ScanPayload:
        return self._scan(0.0, self._step_deg, end_s, None)

    def _part(self, end_s: float) -> sick_wire.ScanPayload:
        """One turn of the mirror, degree by degree; the next begins a step further."""
        parts = max(1, round(1.0 / self._step_deg))
        first_deg, self._turn = self._turn % parts * self._step_deg, self._turn + 1
        return self._scan(first_deg, 1.0, end_s, round(first_deg / 0.25))

    def _scan(self, first_deg: float, step_deg: float, end_s: float, partial: int | None) -> sick_wire.ScanPayload:
        duration_s = sick_wire.MIRROR_S / step_deg * self._field_deg / 360.0
        angles_deg = np.arange(first_deg, self._field_deg + 1e-6, step_deg) - self._field_deg / 2
        times_s = np.linspace(end_s - duration_s, end_s, len(angles_deg))
        is_mm = self._config[UNIT_AT] == 1
        is_32_m = self._config[MEASURING_MODE_AT] == RANGE_32_M
        nothing, scale = (0x7FFF if is_32_m else 0x1FFF), (1e3 if is_mm else 1e2)
        ranges_m = self._sight.ranges_m(times_s, np.radians(angles_deg), 0.05, min(80.0, (nothing - 9) / scale))
        values = np.where(np.isfinite(ranges_m), np.rint(np.where(np.isfinite(ranges_m), ranges_m, 0) * scale), nothing)
        return sick_wire.ScanPayload(tuple(int(v) for v in values), is_mm, partial=partial)


def _means(scan: sick_wire.ScanPayload, n: bytes) -> bytes:
    """The mean of n scans of walls that stand still."""
    return b"\xb6" + n + scan.encode()[1:]


def _sector(scan: sick_wire.ScanPayload, limits: bytes) -> bytes:
    """The values from the first to the last of the limits, counted from 1."""
    first, last = struct.unpack("<HH", limits)
    return b"\xb7" + limits + replace(scan, values=scan.values[max(0, first - 1) : last]).encode()[1:]


class _Nothing:
    def scans_until(self, now_s: float) -> list[list[int]]:
        """See `ScanSource`."""
        return []
