"""LDROBOT LIDARs: LD06, LD19, STL-19P at 230400 baud, STL-27L at 921600; they stream from power-up and take no commands.

    54 2C speed:u16 start:u16 12 x (mm:u16 intensity:u8) end:u16 ms:u16 crc        47 bytes, little-endian; SERIAL.md 2

Angles are hundredths of a degree, clockwise, 0 in front; beam i of 12 lies at start + i (end - start) / 11.  The CRC-8 has
polynomial 0x4D.  `54 2C` occurs inside data often, so a frame is believed by its CRC only, and then only when its angles
and its speed belong together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hw.arrays import Bytes, median
from hw.clock import DeviceClock
from hw.framing import FixedFrames, Frames
from hw.scan_assembler import Beams
from hw.spinning import FixedFrameLidar, carried

HEADER = b"\x54\x2c"
BEAMS = 12
FRAME_BYTES = 47
CLOCK_PERIOD_S = 30.0


@dataclass(frozen=True, slots=True)
class Model:
    """What one type of the family can do."""

    name: str
    baud: int
    samples_per_s: int
    range_max_m: float


MODELS = {
    "ld06": Model("LD06", 230400, 4500, 12.0),
    "ld19": Model("LD19", 230400, 4500, 12.0),
    "stl19p": Model("STL-19P", 230400, 5000, 12.0),
    "stl27l": Model("STL-27L", 921600, 21600, 25.0),
}
RANGE_MIN_M = 0.02
LEAST_DPS, MOST_DPS = 360, 7200  # 1 to 20 turns a second
MOST_FRAME_S = 0.02  # for twelve beams: 600 samples a second, a quarter of what the slowest one takes
LOOSE_SPAN, STRICT_SPAN = 0.5, 0.03  # the vendor's own limit, and that on a line that is not clean


@dataclass(frozen=True, slots=True)
class Packet:
    """One frame, in the sensor's own units."""

    speed_dps: int
    start_cdeg: int  # hundredths of a degree, clockwise
    end_cdeg: int
    clock_ms: int  # 0..29999
    distances_mm: tuple[int, ...]  # 12, 0: no return
    intensities: tuple[int, ...]  # 12


def _crc_table() -> bytes:
    table = bytearray()
    for value in range(256):
        crc = value
        for _ in range(8):
            crc = (crc << 1) ^ (0x4D if crc & 0x80 else 0)
        table.append(crc & 0xFF)
    return bytes(table)


_TABLE = _crc_table()
_TABLE_NP = np.frombuffer(_TABLE, np.uint8)


def crc8(data: bytes | bytearray) -> int:
    """CRC-8, polynomial 0x4D, most significant bit first; 0xC3 over ASCII "123456789"."""
    crc = 0
    table = _TABLE
    for byte in data:
        crc = table[crc ^ byte]
    return crc


def encode(packet: Packet) -> bytes:
    """The frame as it stands on the wire."""
    body = bytearray(HEADER)
    body += packet.speed_dps.to_bytes(2, "little") + packet.start_cdeg.to_bytes(2, "little")
    for distance_mm, intensity in zip(packet.distances_mm, packet.intensities, strict=True):
        body += distance_mm.to_bytes(2, "little")
        body.append(intensity)
    body += packet.end_cdeg.to_bytes(2, "little") + packet.clock_ms.to_bytes(2, "little")
    body.append(crc8(body))
    return bytes(body)


def decode(frame: bytes) -> Packet | None:
    """The packet in these 47 bytes, or None when they are no frame."""
    if len(frame) != FRAME_BYTES or frame[:2] != HEADER or crc8(frame) != 0:
        return None
    beams = frame[6:42]
    return Packet(
        speed_dps=_u16(frame, 2),
        start_cdeg=_u16(frame, 4),
        end_cdeg=_u16(frame, 42),
        clock_ms=_u16(frame, 44),
        distances_mm=tuple(_u16(beams, 3 * i) for i in range(BEAMS)),
        intensities=tuple(beams[2::3]),
    )


def _u16(data: bytes | Bytes, at: int) -> int:
    return int(data[at]) | int(data[at + 1]) << 8


def _are_good(frames: Bytes) -> NDArray[np.bool_]:
    crc = np.zeros(len(frames), np.uint8)
    for column in range(FRAME_BYTES):
        crc = _TABLE_NP[crc ^ frames[:, column]]
    is_good: NDArray[np.bool_] = crc == 0
    return is_good


FRAMES = FixedFrames(HEADER, FRAME_BYTES, lambda frame: crc8(frame) == 0, _are_good)


class Ld06(FixedFrameLidar):
    """Driver of the whole family."""

    frames = FRAMES

    def __init__(self, model: str = "ld06") -> None:
        self.model = MODELS[model]
        super().__init__(RANGE_MIN_M, self.model.range_max_m)
        self.identity.model = self.model.name
        self.bauds = (self.model.baud, 921600 if self.model.baud == 230400 else 230400)
        self.baud = self.model.baud
        self._clock = DeviceClock(CLOCK_PERIOD_S)
        self._last_start_cdeg = 0
        self._frame_s = 0.0  # usual time from the first beam of a frame to its last

    def restart(self) -> None:
        """See `Driver.restart`."""
        super().restart()
        self._clock.restart()

    def _is_turn(self, frames: Frames) -> bool:
        before, last = self._last_start_cdeg, frames.data[-1]
        self._last_start_cdeg = start_cdeg = _u16(last, 4)
        return start_cdeg < before or _u16(last, 42) < start_cdeg

    def _follow(self, data: Bytes, is_strict: bool) -> NDArray[np.bool_]:
        start_cdeg = data[:, 4].astype(np.int64) | data[:, 5].astype(np.int64) << 8
        end_cdeg = data[:, 42].astype(np.int64) | data[:, 43].astype(np.int64) << 8
        step_cdeg = (end_cdeg - start_cdeg) % 36000 / (BEAMS - 1)
        between_cdeg = (start_cdeg[1:] - end_cdeg[:-1]) % 36000
        usual_cdeg = np.minimum(step_cdeg[1:], step_cdeg[:-1])
        off_cdeg = np.abs(between_cdeg - usual_cdeg)
        follows: NDArray[np.bool_] = off_cdeg <= (0.15 * usual_cdeg + 4 if is_strict else 1.5 * usual_cdeg + 10)
        return follows

    def _beams(self, frames: Bytes, gaps: NDArray[np.int64], arrivals_s: NDArray[np.float64]) -> Beams:
        head = np.ascontiguousarray(frames[:, 2:6]).view("<u2").astype(np.float64)  # speed, start
        tail = np.ascontiguousarray(frames[:, 42:46]).view("<u2").astype(np.float64)  # end, ms
        span_cdeg = (tail[:, 0] - head[:, 1]) % 36000.0
        is_sane = (
            (head[:, 1] <= 36000) & (tail[:, 0] <= 36000) & (tail[:, 1] <= 30000) & self._turns_evenly(head[:, 0], span_cdeg)
        )
        self.counters.rejected += int(np.count_nonzero(~is_sane))
        dirty = (gaps > 0) | ~is_sane
        frames, arrivals_s = frames[is_sane], arrivals_s[is_sane]
        head, tail, span_cdeg = head[is_sane], tail[is_sane], span_cdeg[is_sane]
        n = len(frames)
        values = frames[:, 6:42].reshape(n, BEAMS, 3)
        mm = values[:, :, 0].astype(np.float64) + 256.0 * values[:, :, 1]
        fraction = np.arange(BEAMS) / (BEAMS - 1)
        turn_deg = ((head[:, 1, None] + span_cdeg[:, None] * fraction) % 36000.0) / 100.0  # (M, 12) clockwise
        sent_s = FRAME_BYTES * 10.0 / self.baud
        last_s = np.array(
            [self._clock.to_host(ms / 1e3, at) for ms, at in zip(tail[:, 1].tolist(), arrivals_s.tolist(), strict=True)]
        )
        sample_s = span_cdeg / (BEAMS - 1) / 100.0 / np.maximum(head[:, 0], 1.0)
        stamps_s = (last_s - sent_s)[:, None] - sample_s[:, None] * np.arange(BEAMS - 1, -1, -1)
        return Beams(
            turn_deg=turn_deg.ravel(),
            angles_rad=-np.radians(turn_deg).ravel(),
            ranges_m=np.where(mm == 0, np.nan, mm / 1e3).ravel(),
            stamps_s=stamps_s.ravel(),
            intensities=values[:, :, 2].astype(np.float64).ravel(),
            is_dirty=np.repeat(carried(dirty, is_sane), BEAMS),
        )

    def _turns_evenly(self, speed_dps: NDArray[np.float64], span_cdeg: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which frames span what their speed makes of the usual time for twelve beams."""
        frame_s = span_cdeg / 100.0 / np.maximum(speed_dps, 1.0)
        can_be = (speed_dps > LEAST_DPS) & (speed_dps < MOST_DPS) & (frame_s > 0) & (frame_s < MOST_FRAME_S)
        if can_be.any():
            now_s = median(frame_s[can_be])
            has_changed = can_be.sum() >= 8 and abs(now_s - self._frame_s) > 0.1 * self._frame_s
            self._frame_s = now_s if has_changed or not self._frame_s else 0.9 * self._frame_s + 0.1 * now_s
        tolerance = STRICT_SPAN if self._is_strict else LOOSE_SPAN
        is_even: NDArray[np.bool_] = can_be & (np.abs(frame_s - self._frame_s) <= tolerance * self._frame_s)
        return is_even
