"""Kobuki, the base of the TurtleBot 2: feedback packets at 50 Hz with both wheel encoders and a clock.

AA 55 len payload chk         chk = xor of len and payload; payload = {id len data}*; little-endian; SERIAL.md 7.2
core (id 1, 15 bytes)         ms:u16 bumper drop cliff left:u16 right:u16 pwmL pwmR button charger battery overcurrent
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from hw.arrays import Bytes
from hw.byte_window import ByteWindow, Counters
from hw.framing import SizedFrames
from hw.odometry import Quiet, TickSample, WheelGeometry
from hw.rplidar_wire import xor8

BAUD_RATES = (115200,)
HEADER = b"\xaa\x55"
CORE, BASE_CONTROL, REQUEST_EXTRA = 1, 1, 9
MOST_BYTES = 259
CLOCK_PERIOD_S = 65.536
GEOMETRY = WheelGeometry(0.000085292090, 0.230, max_speed_mps=1.0)  # 0.0024369169 rad a tick, wheels of 35 mm

_CORE = struct.Struct("<HBBBHHbbBBBB")


@dataclass(frozen=True, slots=True)
class Core:
    """What the core sub-payload says."""

    clock_ms: int  # u16
    left_ticks: int  # u16
    right_ticks: int  # u16
    bumper: int = 0
    wheel_drop: int = 0
    cliff: int = 0
    battery_dv: int = 160  # tenths of a volt

    def encode(self) -> bytes:
        """Sub-payload with its id and length."""
        counts = (self.clock_ms, self.bumper, self.wheel_drop, self.cliff, self.left_ticks, self.right_ticks)
        return bytes((CORE, _CORE.size)) + _CORE.pack(*counts, 0, 0, 0, 0, self.battery_dv, 0)

    @staticmethod
    def decode(data: bytes) -> Core | None:
        """From the 15 bytes behind id and length."""
        if len(data) != _CORE.size:
            return None
        ms, bumper, drop, cliff, left, right, _, _, _, _, battery_dv, _ = _CORE.unpack(data)
        return Core(ms, left, right, bumper, drop, cliff, battery_dv)


def encode(payload: bytes) -> bytes:
    """A whole frame."""
    body = bytes((len(payload),)) + payload
    return HEADER + body + bytes((xor8(body),))


def decode(frame: bytes) -> dict[int, bytes] | None:
    """Sub-payloads by id, or None when this is no whole frame."""
    if len(frame) < 4 or frame[:2] != HEADER or len(frame) != frame[2] + 4 or xor8(frame[2:]) != 0:
        return None
    parts, at, end = {}, 3, len(frame) - 1
    while at + 2 <= end:
        size = frame[at + 1]
        if at + 2 + size > end:
            return None
        parts[frame[at]] = frame[at + 2 : at + 2 + size]
        at += 2 + size
    return parts if at == end else None


def frames() -> SizedFrames:
    """Finds whole frames, which look the same in both directions."""
    return SizedFrames(HEADER, 3, MOST_BYTES, lambda data: data[2] + 4, lambda frame: decode(frame) is not None)


def unpadded(row: Bytes) -> bytes:
    """The frame in a row of those that were found."""
    return row[: int(row[2]) + 4].tobytes()


def base_control(speed_mm_s: int, radius_mm: int) -> bytes:
    """The command to drive; mapquilt only reads, a simulator understands it."""
    return encode(struct.pack("<BBhh", BASE_CONTROL, 4, speed_mm_s, radius_mm))


def request_extra(flags: int) -> bytes:
    """The command that asks for versions: 1 hardware, 2 firmware, 8 unique id."""
    return encode(struct.pack("<BBH", REQUEST_EXTRA, 2, flags))


class Kobuki(Quiet):
    """`BaseProtocol`: it streams from power-up."""

    baud_rates: tuple[int, ...] = BAUD_RATES

    def __init__(self, geometry: WheelGeometry | None = None) -> None:
        self.geometry = geometry or GEOMETRY
        self.counters = Counters()
        self._window = ByteWindow(self.counters, 4096)
        self._frames = frames()

    def feed(self, data: bytes) -> list[TickSample]:
        """See `BaseProtocol`."""
        self._window.push(data)
        samples = []
        for row in self._frames.take(self._window, self.counters).data:
            parts = decode(unpadded(row)) or {}
            core = Core.decode(parts.get(CORE, b""))
            if core is not None:
                samples.append(TickSample(core.left_ticks, core.right_ticks, 16, core.clock_ms / 1e3, CLOCK_PERIOD_S))
        return samples
