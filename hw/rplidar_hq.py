"""RPLIDAR HQ answers, type 0x83: 96 beams with absolute angles under a CRC-32 (SERIAL.md 1.7).

    A5  time:u64  96 x (angle:u16 distance:u32 quality:u8 flag:u8)  crc:u32                781 bytes, little-endian

Angles count 90 degrees as 16384, distances quarter millimetres; flag bit 0 marks the first beam of a turn.  The CRC covers
the 777 bytes before it and three zeros.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hw.arrays import Bytes, Floats, Ints
from hw.framing import FixedFrames
from hw.scan_assembler import Beams

FRAME_BYTES, BEAMS = 781, 96
DEG_PER_COUNT = 90.0 / 16384.0
_BEAM = np.dtype([("angle", "<u2"), ("distance", "<u4"), ("quality", "u1"), ("flag", "u1")])


def crc(body: bytes) -> int:
    """Of the first 777 bytes, padded to whole words."""
    return zlib.crc32(body + b"\0\0\0")


def is_good(frame: bytes) -> bool:
    """Does the CRC fit?"""
    return crc(frame[:-4]) == int.from_bytes(frame[-4:], "little")


def _are_good(frames: Bytes) -> NDArray[np.bool_]:
    return np.array([is_good(frame.tobytes()) for frame in frames], dtype=bool)


FRAMES = FixedFrames(b"\xa5", FRAME_BYTES, is_good, _are_good)


def encode(angles_deg: Sequence[float], distances_mm: Sequence[float], quality: int = 47, clock_us: int = 0) -> bytes:
    """96 beams, clockwise angles; a turn begins where the angle falls."""
    beams = np.zeros(BEAMS, _BEAM)
    counts = np.round(np.asarray(angles_deg) % 360.0 / DEG_PER_COUNT).astype(np.int64) % 65536
    beams["angle"], beams["distance"] = counts, np.round(np.asarray(distances_mm) * 4)
    beams["quality"], beams["flag"] = quality, np.diff(counts, prepend=counts[0]) < 0
    body = b"\xa5" + clock_us.to_bytes(8, "little") + beams.tobytes()
    return body + crc(body).to_bytes(4, "little")


def decode(frames: Bytes) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """(M, 781) frames to clockwise degrees, millimetres (0: nothing) and quality, (M, 96) each."""
    beams = np.ascontiguousarray(frames[:, 9:-4]).view(_BEAM)
    return beams["angle"] * DEG_PER_COUNT, beams["distance"] / 4.0, beams["quality"].astype(np.float64)


def beams(frames: Bytes, gaps: Ints, sent_s: Floats, period_s: float) -> Beams:
    """What frames say, with the bytes skipped before each and the time at which each was begun to be sent."""
    turn_deg, mm, quality = decode(frames)
    span_deg = (turn_deg[:, -1] - turn_deg[:, 0]) % 360.0
    sample_s = span_deg / 360.0 * period_s / (BEAMS - 1)
    stamps_s = sent_s[:, None] - sample_s[:, None] * np.arange(BEAMS - 1, -1, -1)
    return Beams(
        turn_deg=turn_deg.ravel(),
        angles_rad=-np.radians(turn_deg).ravel(),
        ranges_m=np.where(mm == 0, np.nan, mm / 1e3).ravel(),
        stamps_s=stamps_s.ravel(),
        intensities=quality.ravel(),
        is_dirty=np.repeat(gaps > 0, BEAMS),
    )
