"""WT1, the wheel-encoder frame of a microcontroller of one's own: COBS between zero bytes, CRC-16/CCITT-FALSE at the end.

    wire      COBS(decoded) 00                       resync costs at most one frame: 00 never occurs inside
    encoder   01 seq t_us:u32 left:i32 right:i32 flags crc:u16         little-endian; SERIAL.md 7.8
    info      00 version ticks_per_rev:u16 wheel_radius_um:u32 track_um:u32 name crc:u16

Fifty encoder frames a second are 950 bytes; a lost one costs nothing, a restart shows in `flags` and in time going back.
"""

from __future__ import annotations

import binascii
import struct
from dataclasses import dataclass, field

from hw.byte_window import Counters
from hw.odometry import Quiet, TickSample, WheelGeometry

BAUD_RATES = (115200,)
PROTOCOL_VERSION = 1
MAX_FRAME_BYTES = 96  # the longest info frame is 13 + 64 bytes of name + CRC + COBS overhead
MAX_NAME_BYTES = 64
CLOCK_PERIOD_S = 2**32 / 1e6
FLAG_BOOT, FLAG_LEFT_FAULT, FLAG_RIGHT_FAULT, FLAG_EMERGENCY_STOP = 1, 2, 4, 8

_ENCODER = struct.Struct("<BBIiiB")
_INFO = struct.Struct("<BBHII")


@dataclass(frozen=True, slots=True)
class EncoderFrame:
    """Both wheel counters at one moment of the board's clock."""

    sequence: int  # u8
    clock_us: int  # u32
    left_ticks: int  # i32
    right_ticks: int  # i32
    flags: int = 0

    def ticks(self) -> TickSample:
        faulty = bool(self.flags & (FLAG_LEFT_FAULT | FLAG_RIGHT_FAULT))
        boot = bool(self.flags & FLAG_BOOT)
        clock_s = self.clock_us / 1e6
        return TickSample(self.left_ticks, self.right_ticks, 32, clock_s, CLOCK_PERIOD_S, boot, faulty)


@dataclass(frozen=True, slots=True)
class InfoFrame:
    """What the board says of itself, about once a second."""

    ticks_per_revolution: int  # u16
    wheel_radius_um: int  # u32
    track_um: int  # u32
    name: str = ""
    version: int = PROTOCOL_VERSION

    def geometry(self, max_speed_mps: float = 3.0) -> WheelGeometry:
        return WheelGeometry.of_wheel(self.ticks_per_revolution, self.wheel_radius_um * 1e-6, self.track_um * 1e-6, max_speed_mps)


Frame = EncoderFrame | InfoFrame


def encode(frame: Frame) -> bytes:
    """The frame as it stands on the wire, delimiter included."""
    if isinstance(frame, EncoderFrame):
        body = _ENCODER.pack(1, frame.sequence, frame.clock_us, frame.left_ticks, frame.right_ticks, frame.flags)
    else:
        name = frame.name.encode("ascii", "replace")[:MAX_NAME_BYTES]
        body = _INFO.pack(0, frame.version, frame.ticks_per_revolution, frame.wheel_radius_um, frame.track_um) + name
    return cobs_encode(body + struct.pack("<H", crc16(body))) + b"\0"


def decode(wire: bytes) -> Frame | None:
    """The frame between two delimiters, or None when it is not one."""
    decoded = cobs_decode(wire)
    if decoded is None or len(decoded) < 3:
        return None
    body, (crc,) = decoded[:-2], struct.unpack("<H", decoded[-2:])
    if crc != crc16(body):
        return None
    if body[0] == 1 and len(body) == _ENCODER.size:
        return EncoderFrame(*_ENCODER.unpack(body)[1:])
    if body[0] == 0 and _INFO.size <= len(body) <= _INFO.size + MAX_NAME_BYTES:
        _, version, ticks, radius_um, track_um = _INFO.unpack(body[: _INFO.size])
        is_sane = ticks > 0 and 1_000 <= radius_um <= 2_000_000 and 10_000 <= track_um <= 10_000_000
        name = body[_INFO.size :].decode("ascii", "replace")
        return InfoFrame(ticks, radius_um, track_um, name, version) if is_sane else None
    return None


def crc16(body: bytes) -> int:
    """CRC-16/CCITT-FALSE; 0x29B1 over ASCII "123456789"."""
    return binascii.crc_hqx(body, 0xFFFF)


def cobs_encode(data: bytes) -> bytes:
    """Consistent overhead byte stuffing: the same bytes without a zero, one more for each 254."""
    out, block = bytearray(), bytearray()
    for part in data.split(b"\0"):
        rest = part
        while len(rest) >= 254:
            out += b"\xff" + rest[:254]
            rest = rest[254:]
        block = bytearray((len(rest) + 1,)) + rest
        out += block
    return bytes(out)


def cobs_decode(wire: bytes) -> bytes | None:
    """Undo `cobs_encode`; None when a block runs past the end or holds a zero."""
    if not wire or 0 in wire:
        return None
    out, at = bytearray(), 0
    while at < len(wire):
        code = wire[at]
        block = wire[at + 1 : at + code]
        if len(block) != code - 1:
            return None
        out += block
        at += code
        if code < 255 and at < len(wire):
            out.append(0)
    return bytes(out)


@dataclass
class WheelDecoder:
    """Bytes in any pieces to frames; bounded, total, counts what it refuses."""

    counters: Counters = field(default_factory=Counters)
    _pending: bytearray = field(default_factory=bytearray)
    _is_overlong: bool = False

    def feed(self, data: bytes) -> list[Frame]:
        frames = []
        *ends, tail = data.split(b"\0")
        for piece in ends:
            frame = self._close(piece)
            if frame is not None:
                frames.append(frame)
        self._hold(tail)
        return frames

    def _hold(self, piece: bytes) -> None:
        if len(self._pending) + len(piece) > MAX_FRAME_BYTES:
            self._is_overlong = True
            self._pending.clear()
        elif not self._is_overlong:
            self._pending += piece

    def _close(self, piece: bytes) -> Frame | None:
        self._hold(piece)
        wire, was_overlong = bytes(self._pending), self._is_overlong
        self._pending.clear()
        self._is_overlong = False
        if not wire and not was_overlong:
            return None  # two delimiters in a row are idle line
        frame = None if was_overlong else decode(wire)
        if frame is None:
            self.counters.bad_frames += 1
            self.counters.skip(len(wire) + 1)
            return None
        self.counters.good()
        return frame


class WheelBoard(Quiet):
    """`BaseProtocol` of a WT1 board: it streams by itself and tells its own geometry."""

    baud_rates: tuple[int, ...] = BAUD_RATES

    def __init__(self, geometry: WheelGeometry | None = None, max_speed_mps: float = 3.0) -> None:
        self._is_given = geometry is not None
        self._max_speed_mps = max_speed_mps
        self.geometry = geometry or WheelGeometry(0.0001, 0.3, max_speed_mps)
        self.is_geometry_known = self._is_given
        self._decoder = WheelDecoder()
        self.counters = self._decoder.counters

    def feed(self, data: bytes) -> list[TickSample]:
        """Samples from the first moment at which a tick's worth is known."""
        samples = []
        for frame in self._decoder.feed(data):
            if isinstance(frame, InfoFrame):
                self._learn(frame)
            elif self.is_geometry_known:
                samples.append(frame.ticks())
        return samples

    def _learn(self, info: InfoFrame) -> None:
        if not self._is_given:
            self.geometry = info.geometry(self._max_speed_mps)
            self.is_geometry_known = True
