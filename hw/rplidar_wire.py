"""What is said to an RPLIDAR and what it answers, but for the scans themselves: SERIAL.md 1.2 to 1.4.

request     A5 cmd                              or, when bit 7 of cmd is set, A5 cmd len payload xor
descriptor  A5 5A u32{length:30, multi:2} type  then one answer of that length, or answers back to back
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

SYNC = 0xA5
DESCRIPTOR_BYTES = 7
STOP_CMD, RESET_CMD, SCAN_CMD = 0x25, 0x40, 0x20
EXPRESS_CMD, HQ_CMD, GET_CONF_CMD, SET_CONF_CMD, NEW_BAUD_CMD = 0x82, 0x83, 0x84, 0x85, 0x90
INFO_CMD, HEALTH_CMD, SAMPLERATE_CMD = 0x50, 0x52, 0x59
PWM_CMD, RPM_CMD, BOARD_FLAG_CMD = 0xF0, 0xA8, 0xFF
WITH_PAYLOAD = (EXPRESS_CMD, HQ_CMD, GET_CONF_CMD, SET_CONF_CMD, NEW_BAUD_CMD, PWM_CMD, RPM_CMD, BOARD_FLAG_CMD)
MOST_PAYLOAD = 64  # some hosts fill their questions up to 36 bytes

INFO_TYPE, HEALTH_TYPE, SAMPLERATE_TYPE, CONF_TYPE, CONF_SET_TYPE, BOARD_FLAG_TYPE = 0x04, 0x06, 0x15, 0x20, 0x21, 0xFF
NODE_TYPE, EXPRESS_TYPE, HQ_TYPE, ULTRA_TYPE, DENSE_TYPE, ULTRA_DENSE_TYPE = 0x81, 0x82, 0x83, 0x84, 0x85, 0x86
SCAN_LENGTHS = {NODE_TYPE: 5, EXPRESS_TYPE: 84, HQ_TYPE: 781, ULTRA_TYPE: 132, DENSE_TYPE: 84, ULTRA_DENSE_TYPE: 170}

CONF_MODE_COUNT, CONF_SAMPLE_US, CONF_MAX_DISTANCE = 0x70, 0x71, 0x74
CONF_ANSWER_TYPE, CONF_TYPICAL_MODE, CONF_MODE_NAME = 0x75, 0x7C, 0x7F
CONF_OF_MODES = (CONF_SAMPLE_US, CONF_MAX_DISTANCE, CONF_ANSWER_TYPE, CONF_MODE_NAME)
CONF_SPEED, CONF_SLOWEST, CONF_FASTEST, CONF_MODEL_NAME = 0x01, 0x04, 0x05, 0x81
MAX_ANSWER_BYTES = 256


def xor8(data: bytes | bytearray) -> int:
    """XOR of all bytes, by folding one big number in half until a byte is left."""
    x = int.from_bytes(data, "little")
    shift = 8
    while shift * 2 < len(data) * 8:
        shift *= 2
    while shift >= 8:
        x ^= x >> shift
        shift //= 2
    return x & 0xFF


def request(command: int, payload: bytes = b"") -> bytes:
    """A request as it stands on the wire."""
    if not command & 0x80:
        return bytes((SYNC, command))
    body = bytes((SYNC, command, len(payload))) + payload
    return body + bytes((xor8(body),))


def express_request(mode: int) -> bytes:
    """Start scanning in this mode."""
    return request(EXPRESS_CMD, struct.pack("<BHH", mode, 0, 0))


def conf_request(key: int, mode: int | None = None) -> bytes:
    """Ask for one configuration value, of one scan mode where it has one."""
    return request(GET_CONF_CMD, struct.pack("<I", key) + (b"" if mode is None else struct.pack("<H", mode)))


@dataclass(frozen=True, slots=True)
class Request:
    """A request as the device reads it."""

    command: int
    payload: bytes = b""


def parse_request(data: bytes | bytearray) -> tuple[Request | None, int]:
    """The first request in these bytes, and how many bytes are done with; (None, 0): more is needed."""
    at = data.find(SYNC)
    if at < 0:
        return None, len(data)
    if len(data) < at + 2:
        return None, at
    command = data[at + 1]
    if command < 0x80:
        return Request(command), at + 2
    if command not in WITH_PAYLOAD or (len(data) > at + 2 and data[at + 2] > MOST_PAYLOAD):
        return None, at + 1  # the second byte may itself begin a request
    if len(data) < at + 3 or len(data) < at + 4 + data[at + 2]:
        return None, at
    end = at + 4 + data[at + 2]
    if xor8(data[at:end]) != 0:
        return None, at + 1
    return Request(command, bytes(data[at + 3 : end - 1])), end


@dataclass(frozen=True, slots=True)
class Descriptor:
    """What comes next, and whether again and again."""

    length: int
    is_multi: bool
    type: int

    def encode(self) -> bytes:
        return b"\xa5\x5a" + struct.pack("<IB", self.length | (0x40000000 if self.is_multi else 0), self.type)

    @staticmethod
    def decode(data: bytes | bytearray) -> Descriptor | None:
        """The descriptor in these 7 bytes, or None when they are none of a kind we know."""
        if len(data) < DESCRIPTOR_BYTES or data[:2] != b"\xa5\x5a":
            return None
        word, kind = struct.unpack_from("<IB", data, 2)
        found = Descriptor(word & 0x3FFFFFFF, word >> 30 == 1, kind)
        if word >> 30 > 1 or found.length == 0:
            return None
        if found.is_multi:
            return found if SCAN_LENGTHS.get(kind) == found.length else None
        return found if kind not in SCAN_LENGTHS and found.length <= MAX_ANSWER_BYTES else None


@dataclass(frozen=True, slots=True)
class Info:
    """GET_INFO: who it is."""

    model: int
    firmware: tuple[int, int]  # major, minor
    hardware: int
    serial: bytes  # 16

    def encode(self) -> bytes:
        return bytes((self.model, self.firmware[1], self.firmware[0], self.hardware)) + self.serial

    @staticmethod
    def decode(data: bytes) -> Info | None:
        return Info(data[0], (data[2], data[1]), data[3], bytes(data[4:20])) if len(data) == 20 else None

    @property
    def series(self) -> int:
        """1..3 A, 4..5 C, 6..8 S, 9..11 T, 12 and more M."""
        return self.model >> 4

    @property
    def name(self) -> str:
        """As printed on the case, as far as the model byte tells."""
        for least, letter in ((12, "M"), (9, "T"), (6, "S"), (4, "C"), (1, "A")):
            if self.series >= least:
                return f"RPLIDAR {letter}{self.series - least + 1}M{self.model & 15}"
        return f"RPLIDAR (model {self.model:#04x})"

    @property
    def has_conf(self) -> bool:
        """Does it know GET_LIDAR_CONF?"""
        return self.series >= 4 or self.firmware >= (1, 24)

    @property
    def has_express(self) -> bool:
        """Does it know the express mode?"""
        return self.firmware >= (1, 17)


@dataclass(frozen=True, slots=True)
class Health:
    """GET_HEALTH: 0 good, 1 warning, 2 error (protection stop)."""

    status: int
    error_code: int = 0

    def encode(self) -> bytes:
        return struct.pack("<BH", self.status, self.error_code)

    @staticmethod
    def decode(data: bytes) -> Health | None:
        return Health(*struct.unpack("<BH", data)) if len(data) == 3 else None


@dataclass(frozen=True, slots=True)
class Conf:
    """GET_LIDAR_CONF: a value and the key it belongs to."""

    key: int
    value: bytes

    def encode(self) -> bytes:
        return struct.pack("<I", self.key) + self.value

    @staticmethod
    def decode(data: bytes) -> Conf | None:
        return Conf(struct.unpack_from("<I", data)[0], bytes(data[4:])) if len(data) >= 4 else None

    @property
    def number(self) -> int:
        """The value as a little-endian whole number."""
        return int.from_bytes(self.value[:4], "little")


def answer(kind: int, body: bytes) -> bytes:
    """A single answer with its descriptor."""
    return Descriptor(len(body), False, kind).encode() + body
