"""Two small spinning LIDARs with the same kind of packet (SERIAL.md 6.1 and 6.2).

Neato XV-11 and its kin (Botvac, LDS02RR), 115200 baud, 90 packets a turn of 4 beams, one degree each, counter-clockwise:

    FA  A0+i  rpm*64:u16  4 x (mm:14 weak:1 invalid:1, signal:u16)  checksum:u16            22 bytes

Hitachi-LG LDS-01 (TurtleBot 3), 230400 baud, 'b' starts and 'e' stops it, 60 packets a turn of 6 beams, clockwise:

    FA  A0+i  rpm*10:u16  6 x (signal:u16 mm:u16 reserved:u16)      checksum:u16            42 bytes

The checksum is a folded sum of the little-endian words before it.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hw.arrays import Bytes
from hw.driver import Drain, Script, Send
from hw.framing import FixedFrames, Frames
from hw.scan_assembler import Beams
from hw.spinning import FixedFrameLidar

HEADER = 0xFA
FIRST_INDEX = 0xA0


def checksum(data: bytes) -> int:
    """c = 2c + word over all words, folded to 15 bits."""
    total = 0
    for (word,) in struct.iter_unpack("<H", data):
        total = (total << 1) + word
    return (total & 0x7FFF) + (total >> 15) & 0x7FFF


def _checksums(frames: Bytes) -> NDArray[np.int64]:
    """`checksum` of many frames: (M, even) -> (M,)."""
    words = np.ascontiguousarray(frames).view("<u2").astype(np.int64)
    total: NDArray[np.int64] = words @ (1 << np.arange(words.shape[1] - 1, -1, -1, dtype=np.int64))
    return (total & 0x7FFF) + (total >> 15) & 0x7FFF


@dataclass(frozen=True, slots=True)
class Kind:
    """What tells the two apart."""

    name: str
    baud: int
    frame_bytes: int
    packets: int  # a turn
    rpm_scale: float
    range_min_m: float
    range_max_m: float
    start: bytes = b""
    stop: bytes = b""

    @property
    def beams(self) -> int:
        return 360 // self.packets

    def frames(self) -> FixedFrames:
        """Finds packets of this kind."""
        return FixedFrames(bytes((HEADER,)), self.frame_bytes, self.is_good, self._are_good)

    def is_good(self, frame: bytes) -> bool:
        """Is the index one of a turn, and the checksum right?"""
        return 0 <= frame[1] - FIRST_INDEX < self.packets and checksum(frame[:-2]) == (frame[-2] | frame[-1] << 8)

    def _are_good(self, frames: Bytes) -> NDArray[np.bool_]:
        index = frames[:, 1].astype(np.int64) - FIRST_INDEX
        told = frames[:, -2].astype(np.int64) | frames[:, -1].astype(np.int64) << 8
        is_good: NDArray[np.bool_] = (index >= 0) & (index < self.packets) & (_checksums(frames[:, :-2]) == told)
        return is_good


XV11 = Kind("Neato XV-11", 115200, 22, 90, 64.0, 0.06, 6.0)
LDS01 = Kind("LDS-01", 230400, 42, 60, 10.0, 0.12, 3.5, b"b", b"e")
LEAST_RPM, MOST_RPM = 100.0, 600.0  # XV-11 works at 180 to 349, LDS-01 at 300


@dataclass(frozen=True, slots=True)
class Packet:
    """One packet of either kind."""

    index: int  # 0..89 or 0..59
    rpm: float
    distances_mm: tuple[int, ...]
    signals: tuple[int, ...]
    is_weak: tuple[bool, ...] = ()  # XV-11 only
    is_invalid: tuple[bool, ...] = ()  # XV-11 only; the distance is then an error code


def encode_xv11(packet: Packet) -> bytes:
    """An XV-11 packet as it stands on the wire."""
    body = struct.pack("<BBH", HEADER, FIRST_INDEX + packet.index, round(packet.rpm * XV11.rpm_scale))
    weak, invalid = packet.is_weak or (False,) * 4, packet.is_invalid or (False,) * 4
    for k in range(4):
        body += struct.pack("<HH", packet.distances_mm[k] | weak[k] << 14 | invalid[k] << 15, packet.signals[k])
    return body + struct.pack("<H", checksum(body))


def encode_lds01(packet: Packet) -> bytes:
    """An LDS-01 packet as it stands on the wire."""
    body = struct.pack("<BBH", HEADER, FIRST_INDEX + packet.index, round(packet.rpm * LDS01.rpm_scale))
    for k in range(6):
        body += struct.pack("<HHH", packet.signals[k], packet.distances_mm[k], 0)
    return body + struct.pack("<H", checksum(body))


def decode_xv11(frame: bytes) -> Packet | None:
    """The packet in these 22 bytes, or None when they are none."""
    if len(frame) != XV11.frame_bytes or frame[0] != HEADER or not XV11.is_good(frame):
        return None
    words = struct.unpack("<H8H", frame[2:20])
    mm, signals = words[1::2], words[2::2]
    weak, invalid = tuple(bool(d >> 14 & 1) for d in mm), tuple(bool(d >> 15) for d in mm)
    return Packet(frame[1] - FIRST_INDEX, words[0] / XV11.rpm_scale, tuple(d & 0x3FFF for d in mm), signals, weak, invalid)


def decode_lds01(frame: bytes) -> Packet | None:
    """The packet in these 42 bytes, or None when they are none."""
    if len(frame) != LDS01.frame_bytes or frame[0] != HEADER or not LDS01.is_good(frame):
        return None
    words: Sequence[int] = struct.unpack("<19H", frame[2:40])
    return Packet(frame[1] - FIRST_INDEX, words[0] / LDS01.rpm_scale, tuple(words[2::3]), tuple(words[1::3]))


class Xv11(FixedFrameLidar):
    """Driver of both kinds."""

    def __init__(self, kind: Kind = XV11) -> None:
        super().__init__(kind.range_min_m, kind.range_max_m)
        self.kind = kind
        self.frames = kind.frames()
        self.identity.model = kind.name
        self.bauds = (kind.baud,)
        self.baud = kind.baud
        self._assembler.witnesses = tuple(range(1, kind.beams // 2 + 1))  # of any beam some lie in another packet
        self._last_index = 0

    def start(self) -> Script:
        """See `Driver.start`; the XV-11 streams as soon as its motor turns."""
        if self.kind.start:
            yield Send(self.kind.stop)
            yield Drain()
            yield Send(self.kind.start)

    def stop(self) -> Script:
        """See `Driver.stop`."""
        if self.kind.stop:
            yield Send(self.kind.stop)

    def _is_turn(self, frames: Frames) -> bool:
        before, self._last_index = self._last_index, int(frames.data[-1, 1])
        return self._last_index <= before

    def _follow(self, data: Bytes, is_strict: bool) -> NDArray[np.bool_]:
        index = data[:, 1].astype(np.int64)
        follows: NDArray[np.bool_] = (index[1:] - index[:-1]) % self.kind.packets == 1
        return follows

    def _beams(self, frames: Bytes, gaps: NDArray[np.int64], arrivals_s: NDArray[np.float64]) -> Beams:
        n = self.kind.beams
        words = np.ascontiguousarray(frames[:, 2:-2]).view("<u2").astype(np.int64)
        rpm = words[:, 0] / self.kind.rpm_scale
        values = words[:, 1:].reshape(len(frames), n, -1)
        turn_deg = (frames[:, 1].astype(np.float64) - FIRST_INDEX)[:, None] * n + np.arange(n)
        if self.kind is XV11:
            mm, signal = values[:, :, 0] & 0x3FFF, values[:, :, 1]
            mm = np.where(values[:, :, 0] >> 15 == 1, 0, mm)
            angles_deg = turn_deg
        else:
            signal, mm = values[:, :, 0], values[:, :, 1]
            angles_deg = 359.0 - turn_deg
        is_sane = (rpm > LEAST_RPM) & (rpm < MOST_RPM)  # started or blocked, the head is not where it says
        sample_s = 1.0 / (6.0 * np.clip(rpm, LEAST_RPM, MOST_RPM))
        sent_s = self.kind.frame_bytes * 10.0 / self.baud
        stamps_s = (arrivals_s - sent_s)[:, None] - sample_s[:, None] * np.arange(n - 1, -1, -1)
        self.counters.rejected += int(np.count_nonzero(~is_sane))
        return Beams(
            turn_deg=turn_deg.ravel(),
            angles_rad=np.radians(angles_deg).ravel(),
            ranges_m=np.where((mm == 0) | ~is_sane[:, None], np.nan, mm / 1e3).ravel(),
            stamps_s=stamps_s.ravel(),
            intensities=signal.astype(np.float64).ravel(),
            is_dirty=np.repeat(gaps > 0, n),
        )
