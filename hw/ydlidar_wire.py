"""The bytes of YDLIDAR's serial family, X2, X4, G2, G4, S2, Tmini, TG ..., both ways (SERIAL.md 3).

    AA 55  ct  lsn  fsa:u16  lsa:u16  cs:u16  lsn samples of 2, 3 or 4 bytes                little-endian

`ct` bit 0 marks the start of a turn, `lsn` counts samples, `fsa` and `lsa` are the angles of the first and last sample in
1/64 degree above bit 0, clockwise.  A sample is a distance (2 bytes), an intensity byte and a distance (3), or an intensity
word and a distance (4).
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hw.arrays import Floats
from hw.rplidar_wire import Descriptor, xor8

HEADER = b"\xaa\x55"
CLOCK_HEADER = b"\xaa\x66"
HEAD_BYTES = 10
MOST_SAMPLES = 80
SCAN, STOP, FORCE_STOP, INFO, HEALTH, RESET = 0x60, 0x65, 0x00, 0x90, 0x92, 0x80
INFO_TYPE, HEALTH_TYPE, SCAN_TYPE = 0x04, 0x06, 0x81


@dataclass(frozen=True, slots=True)
class Model:
    """What must be known of a unit besides its bytes."""

    name: str
    baud: int
    is_two_way: bool = True
    is_triangle: bool = True  # distances in quarter millimetres and an angle correction; else time of flight
    is_corrected: bool = True
    range_max_m: float = 12.0
    motor_dtr: bool = True  # level of DTR at which the motor runs


MODELS = {
    "x2": Model("X2", 115200, is_two_way=False, range_max_m=8.0),
    "x4": Model("X4", 128000, range_max_m=10.0),
    "x4pro": Model("X4 Pro", 128000, is_two_way=False, range_max_m=10.0),
    "s2": Model("S2", 115200, is_two_way=False, range_max_m=8.0),
    "s4": Model("S4", 115200, range_max_m=8.0),
    "s4b": Model("S4B", 153600, range_max_m=8.0),
    "g1": Model("G1", 230400),
    "g2": Model("G2", 230400),
    "g4": Model("G4", 230400, range_max_m=16.0),
    "g4b": Model("G4B", 512000, range_max_m=16.0),
    "g6": Model("G6", 512000, range_max_m=25.0),
    "tmini": Model("Tmini", 230400, is_corrected=False),
    "tg15": Model("TG15", 512000, is_triangle=False, is_corrected=False, range_max_m=15.0),
    "tg30": Model("TG30", 512000, is_triangle=False, is_corrected=False, range_max_m=30.0),
    "tg50": Model("TG50", 512000, is_triangle=False, is_corrected=False, range_max_m=50.0),
    "tx8": Model("TX8", 115200, is_two_way=False, is_triangle=False, is_corrected=False, range_max_m=8.0),
    "tx20": Model("TX20", 115200, is_two_way=False, is_triangle=False, is_corrected=False, range_max_m=20.0),
}
NUMBERS = {4: "s4", 5: "g4", 6: "x4", 7: "g4", 13: "g6", 14: "g2", 15: "g2", 16: "g2", 17: "g4b", 18: "g4", 19: "g1", 20: "g4"}
NUMBERS |= {21: "g6", 100: "tg15", 101: "tg30", 102: "tg50", 150: "tmini", 151: "tmini", 152: "tmini"}
RANGE_MIN_M = 0.05


@dataclass(frozen=True, slots=True)
class Packet:
    """One scan packet in the sensor's units."""

    is_start: bool
    scan_hz: float  # 0: not told
    first_q6: int  # 1/64 degree, clockwise
    last_q6: int
    samples: tuple[int, ...]  # distance words
    intensities: tuple[int, ...] = ()  # as many, or none


def words_xor(data: bytes, sample_bytes: int) -> int:
    """The XOR of a packet's words but its checksum; a 3-byte sample counts as a byte and a word."""
    head = int.from_bytes(data[0:2], "little") ^ int.from_bytes(data[2:4], "little")
    head ^= int.from_bytes(data[4:6], "little") ^ int.from_bytes(data[6:8], "little")
    body = data[HEAD_BYTES:]
    if sample_bytes == 3:
        return head ^ xor8(body[0::3]) ^ xor8(body[1::3]) ^ xor8(body[2::3]) << 8
    return head ^ xor8(body[0::2]) ^ xor8(body[1::2]) << 8


def encode(packet: Packet, sample_bytes: int = 2) -> bytes:
    """The packet as it stands on the wire, with samples of 2, 3 or 4 bytes."""
    ct = round(packet.scan_hz * 10) << 1 | packet.is_start
    angles = (packet.first_q6 << 1 | 1, packet.last_q6 << 1 | 1)
    head = HEADER + struct.pack("<BBHH", ct, len(packet.samples), *angles)
    intensities = packet.intensities or (0,) * len(packet.samples)
    if sample_bytes == 2:
        body = struct.pack(f"<{len(packet.samples)}H", *packet.samples)
    else:
        layout = "<BH" if sample_bytes == 3 else "<HH"
        body = b"".join(struct.pack(layout, i, d) for i, d in zip(intensities, packet.samples, strict=True))
    return head + words_xor(head + b"\0\0" + body, sample_bytes).to_bytes(2, "little") + body


def decode(frame: bytes) -> Packet | None:
    """The packet in these bytes, which must be exactly one; its sample width is told by its length."""
    if len(frame) < HEAD_BYTES or frame[:2] != HEADER or not 1 <= frame[3] <= MOST_SAMPLES:
        return None
    n = frame[3]
    sample_bytes = (len(frame) - HEAD_BYTES) // n
    if len(frame) != HEAD_BYTES + n * sample_bytes or sample_bytes not in (2, 3, 4):
        return None
    first, last, told = struct.unpack_from("<HHH", frame, 4)
    if not first & last & 1 or words_xor(frame, sample_bytes) != told:
        return None
    layout = {2: "<H", 3: "<BH", 4: "<HH"}[sample_bytes]
    values = list(struct.iter_unpack(layout, frame[HEAD_BYTES:]))
    intensities = tuple(v[0] for v in values) if sample_bytes > 2 else ()
    return Packet(bool(frame[2] & 1), (frame[2] >> 1) / 10, first >> 1, last >> 1, tuple(v[-1] for v in values), intensities)


def encode_clock(clock_ms: int) -> bytes:
    """The time stamp packet newer units send between scan packets."""
    body = CLOCK_HEADER + b"\0" + clock_ms.to_bytes(4, "little") + b"\0"
    return body[:2] + bytes((xor8(body),)) + body[3:]


def command(code: int) -> bytes:
    """A command as it stands on the wire."""
    return bytes((0xA5, code))


def correction_deg(mm: Floats) -> Floats:
    """The second-level angle correction of triangulating units, to add to the clockwise angle; 0 where nothing was seen."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(mm > 0, np.degrees(np.arctan(21.8 * (155.3 - mm) / (155.3 * mm))), 0.0)


def answer(kind: int, body: bytes) -> bytes:
    """A two-way unit's answer with its descriptor."""
    return Descriptor(len(body), False, kind).encode() + body


def info_body(model_number: int, firmware: tuple[int, int], hardware: int, serial: Sequence[int]) -> bytes:
    """The 20 bytes of the device information."""
    return bytes((model_number, firmware[1], firmware[0], hardware, *serial))
