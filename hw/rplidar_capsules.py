"""RPLIDAR scan answers that carry many beams and a checksum: types 0x82, 0x84, 0x85, 0x86 (SERIAL.md 1.7).

    b0  A:4 xor_low:4     b1  5:4 xor_high:4     ...  start:u16  (bit 15: first capsule of a stream, bits 0..14: 1/64 deg)  beams

Beams of capsule k lie between its start angle and the next capsule's, so a capsule is decoded when the next one is there.
Each kind writes what it parses: `encode` is what a simulator sends.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from hw.arrays import Bytes, Floats, Ints
from hw.framing import FixedFrames
from hw.rplidar_wire import DENSE_TYPE, EXPRESS_TYPE, ULTRA_DENSE_TYPE, ULTRA_TYPE, xor8


@dataclass(frozen=True, slots=True)
class Beams:
    """Decoded beams of M capsules, n each."""

    distance_mm: Floats  # (M, n) 0: nothing
    offset_deg: Floats  # (M, n) to subtract from the interpolated angle
    quality: Floats | None = None  # (M, n)


class CapsuleKind(Protocol):
    """One answer type."""

    type: int
    length: int
    samples: int
    start_at: int  # where the start angle stands

    def decode(self, this: Bytes, following: Bytes) -> Beams:
        """(M, length) capsules and their followers to beams."""


def _are_good(frames: Bytes) -> NDArray[np.bool_]:
    is_good: NDArray[np.bool_] = np.bitwise_xor.reduce(frames[:, 2:], axis=1) == (frames[:, 0] & 15 | frames[:, 1] << 4)
    return is_good


def frames_of(kind: CapsuleKind) -> FixedFrames:
    """Finds capsules of this kind."""
    return FixedFrames(
        b"\xa0\x50", kind.length, lambda f: xor8(f[2:]) == (f[0] & 15 | (f[1] & 15) << 4), _are_good, header_mask=b"\xf0\xf0"
    )


def start_angles_q6(kind: CapsuleKind, frames: Bytes) -> tuple[Ints, NDArray[np.bool_]]:
    """Start angle of each capsule in 1/64 degree, and whether it is the first of a stream."""
    word = frames[:, kind.start_at].astype(np.int64) | frames[:, kind.start_at + 1].astype(np.int64) << 8
    return word & 0x7FFF, word >> 15 == 1


def _sealed(body: bytes) -> bytes:
    """A capsule around everything from byte 2 on."""
    chk = xor8(body)
    return bytes((0xA0 | chk & 15, 0x50 | chk >> 4)) + body


def _start(angle_q6: int, is_first: bool) -> bytes:
    return (angle_q6 | (0x8000 if is_first else 0)).to_bytes(2, "little")


def _u16(frames: Bytes, columns: slice) -> Ints:
    return np.ascontiguousarray(frames[:, columns]).view("<u2").astype(np.int64)


class Express:
    """0x82: 16 cabins of two beams, `u16 da1, u16 da2, u8 offsets`; quarter millimetres, offsets in 1/8 degree."""

    type, length, samples, start_at = EXPRESS_TYPE, 84, 32, 2

    def decode(self, this: Bytes, following: Bytes) -> Beams:
        cabins = this[:, 4:].reshape(-1, 16, 5).astype(np.int64)
        da1 = cabins[:, :, 0] | cabins[:, :, 1] << 8
        da2 = cabins[:, :, 2] | cabins[:, :, 3] << 8
        off = cabins[:, :, 4]
        distance_q2 = np.stack([da1 & ~3, da2 & ~3], axis=2).reshape(-1, 32)
        offset_q3 = np.stack([off & 15 | (da1 & 3) << 4, off >> 4 | (da2 & 3) << 4], axis=2).reshape(-1, 32)
        return Beams(distance_q2 / 4.0, offset_q3 / 8.0)

    def encode(
        self, start_q6: int, distances_mm: Sequence[int], offsets_q3: Sequence[int] = (0,) * 32, is_first: bool = False
    ) -> bytes:
        """32 whole millimetres below 16384."""
        out = bytearray(_start(start_q6, is_first))
        for i in range(0, 32, 2):
            o1, o2 = offsets_q3[i], offsets_q3[i + 1]
            out += (distances_mm[i] << 2 | o1 >> 4).to_bytes(2, "little")
            out += (distances_mm[i + 1] << 2 | o2 >> 4).to_bytes(2, "little")
            out.append(o1 & 15 | (o2 & 15) << 4)
        return _sealed(bytes(out))


class Dense:
    """0x85: 40 distances in millimetres."""

    type, length, samples, start_at = DENSE_TYPE, 84, 40, 2

    def decode(self, this: Bytes, following: Bytes) -> Beams:
        mm = _u16(this, slice(4, 84)).astype(np.float64)
        return Beams(mm, np.zeros_like(mm))

    def encode(self, start_q6: int, distances_mm: Sequence[int], is_first: bool = False) -> bytes:
        """40 whole millimetres below 65536."""
        return _sealed(_start(start_q6, is_first) + b"".join(mm.to_bytes(2, "little") for mm in distances_mm))


# variable bit scale: (least coded value, least distance, level); a value v at level l stands for base + (v - least) << l
_SCALES = ((3328, 16384, 4), (1792, 4096, 3), (1280, 2048, 2), (512, 512, 1), (0, 0, 0))


def scale_up(coded: Ints) -> tuple[Ints, Ints]:
    """Coded major value (12 bits) to millimetres and level."""
    mm, level = coded.copy(), np.zeros_like(coded)
    for least, base, shift in reversed(_SCALES[:-1]):
        there = coded >= least
        mm = np.where(there, base + (coded - least << shift), mm)
        level = np.where(there, shift, level)
    return mm, level


def scale_down(mm: int) -> int:
    """Millimetres to the coded major value, rounded down to what its level can tell."""
    for least, base, shift in _SCALES:
        if mm >= base:
            return min(least + (mm - base >> shift), 4095)
    return 0


class Ultra:
    """0x84: 32 cabins `u32 {major:12, predict1:10, predict2:10}`, three beams each; predictions lean on majors."""

    type, length, samples, start_at = ULTRA_TYPE, 132, 96, 2

    def decode(self, this: Bytes, following: Bytes) -> Beams:
        words = np.ascontiguousarray(this[:, 4:132]).view("<u4").astype(np.int64)  # (M, 32)
        next_first = np.ascontiguousarray(following[:, 4:8]).view("<u4").astype(np.int64)
        major, level = scale_up(np.concatenate([words, next_first], axis=1) & 0xFFF)  # (M, 33)
        m, m_next, lvl, lvl_next = major[:, :-1], major[:, 1:], level[:, :-1], level[:, 1:]
        p1 = (words >> 12 & 0x3FF ^ 0x200) - 0x200
        p2 = (words >> 22 & 0x3FF ^ 0x200) - 0x200
        borrow = (m == 0) & (m_next != 0)
        base1, lvl1 = np.where(borrow, m_next, m), np.where(borrow, lvl_next, lvl)
        d1 = np.where((p1 == -512) | (p1 == 511), 0, base1 + (p1 << lvl1))
        d2 = np.where((p2 == -512) | (p2 == 511), 0, m_next + (p2 << lvl_next))
        mm = np.stack([m, d1, d2], axis=2).reshape(-1, 96).clip(0).astype(np.float64)
        return Beams(mm, ultra_offset_deg(mm))

    def encode(self, start_q6: int, distances_mm: Sequence[int], next_mm: int, is_first: bool = False) -> bytes:
        """96 millimetres, and the first of the next capsule, which the last prediction leans on."""
        majors = [scale_down(mm) for mm in distances_mm[::3]] + [scale_down(next_mm)]
        values, levels = (a.tolist() for a in scale_up(np.array(majors, np.int64)))
        out = bytearray(_start(start_q6, is_first))
        for i in range(32):
            k = i + 1 if values[i] == 0 and values[i + 1] != 0 else i
            p1 = _predict(distances_mm[3 * i + 1], values[k], levels[k])
            p2 = _predict(distances_mm[3 * i + 2], values[i + 1], levels[i + 1])
            out += (majors[i] | (p1 & 0x3FF) << 12 | (p2 & 0x3FF) << 22).to_bytes(4, "little")
        return _sealed(bytes(out))


def _predict(mm: int, base: int, level: int) -> int:
    """The 10-bit prediction nearest to mm; -512 says "no return", also when it cannot be said."""
    steps = mm - base + (1 << level >> 1) >> level
    return steps if mm > 0 and -512 < steps < 511 else -512


def ultra_offset_deg(mm: Floats) -> Floats:
    """How far beams of the triangulating ultra mode are turned back, by distance."""
    k2 = np.floor(98361.0 / np.maximum(4.0 * mm, 1.0))
    offset_rad = np.radians(8.0) - (k2 * 64.0 + k2**3 / 98304.0) / 65536.0
    return np.where(mm < 50, 7.5, np.degrees(offset_rad))


_STEPS = ((2, 0, 10, 0), (3, 2046, 11, 1), (4, 8187, 12, 2), (5, 24567, 13, 3))  # (mm a step, first mm, bits, quality shift)


class UltraDense:
    """0x86: time stamp, status, then 32 cabins `u16 a, u16 b, u8 high`, two beams each of 20 bits: scale, distance, quality."""

    type, length, samples, start_at = ULTRA_DENSE_TYPE, 170, 64, 8

    def decode(self, this: Bytes, following: Bytes) -> Beams:
        cabins = this[:, 10:170].reshape(-1, 32, 5).astype(np.int64)
        high = cabins[:, :, 4]
        a = cabins[:, :, 0] | cabins[:, :, 1] << 8 | (high & 15) << 16
        b = cabins[:, :, 2] | cabins[:, :, 3] << 8 | high >> 4 << 16
        value = np.stack([a, b], axis=2).reshape(-1, 64)
        scale = value & 3
        mm = np.zeros_like(value)
        quality = np.zeros_like(value)
        for s, (step, first, bits, shift) in enumerate(_STEPS):
            is_s = scale == s
            mm = np.where(is_s, (value >> 2 & (1 << bits) - 1) * step + first, mm)
            quality = np.where(is_s, value >> 2 + bits << shift, quality)
        return Beams(mm.astype(np.float64), np.zeros(mm.shape), quality.astype(np.float64))

    def encode(
        self,
        start_q6: int,
        distances_mm: Sequence[int],
        qualities: Sequence[int] = (47,) * 64,
        clock_us: int = 0,
        is_first: bool = False,
    ) -> bytes:
        """64 millimetres below 65530, rounded to what their scale can tell."""
        out = bytearray(clock_us.to_bytes(4, "little") + b"\0\0" + _start(start_q6, is_first))
        for i in range(0, 64, 2):
            a, b = _packed(distances_mm[i], qualities[i]), _packed(distances_mm[i + 1], qualities[i + 1])
            out += (a & 0xFFFF).to_bytes(2, "little") + (b & 0xFFFF).to_bytes(2, "little")
            out.append(a >> 16 | b >> 16 << 4)
        return _sealed(bytes(out))


def _packed(mm: int, quality: int) -> int:
    scale = next(s for s in (3, 2, 1, 0) if mm >= _STEPS[s][1])
    step, first, bits, shift = _STEPS[scale]
    return scale | min((mm - first) // step, (1 << bits) - 1) << 2 | min(quality >> shift, (1 << 18 - bits) - 1) << 2 + bits


KINDS: dict[int, CapsuleKind] = {kind.type: kind for kind in (Express(), Dense(), Ultra(), UltraDense())}
