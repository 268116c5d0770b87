"""The telegrams of a SICK LMS200, 211, 220, 221 or 291, both ways (SERIAL.md 5).

    02 addr len:u16 payload crc:u16        host to scanner at address 00, scanner to host at 80; 06 before an answer: accepted

A scan is a payload `B0 info:u16 value:u16 ... status`: 181 values over 180 degrees, 361 at half a degree, or 101, 201, 401
over 100 degrees, counter-clockwise from the right.  The unit (cm or mm) stands in `info`.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

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


def is_whole(telegram: bytes) -> bool:
    """Does its checksum fit?"""
    return crc16(telegram[:-2]) == (telegram[-2] | telegram[-1] << 8)


def decode(telegram: bytes) -> tuple[int, bytes] | None:
    """(address, payload) of these bytes, which must be exactly one telegram; else None."""
    if len(telegram) < 7 or telegram[0] != STX or len(telegram) != 6 + (telegram[2] | telegram[3] << 8):
        return None
    return (telegram[1], telegram[4:-2]) if is_whole(telegram) else None


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


def scan_telegram(values: Sequence[int], is_mm: bool = False) -> bytes:
    """A scan as the scanner sends it."""
    return encode(ScanPayload(tuple(values), is_mm).encode(), SCANNER_ADDRESS)
