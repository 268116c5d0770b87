"""What the capsule encoders write, the decoders read; and nothing that was damaged."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hw import rplidar_hq
from hw.byte_window import ByteWindow, Counters
from hw.rplidar_capsules import KINDS, Dense, Express, Ultra, UltraDense, frames_of, scale_down, scale_up, start_angles_q6

angle_q6 = st.integers(0, 360 * 64 - 1)


def _rows(*capsules: bytes) -> np.ndarray:
    return np.frombuffer(b"".join(capsules), np.uint8).reshape(len(capsules), -1)


@settings(max_examples=40, deadline=None)
@given(
    angle_q6, st.lists(st.integers(0, 16383), min_size=32, max_size=32), st.lists(st.integers(0, 63), min_size=32, max_size=32)
)
def test_express(start: int, mm: list[int], offsets: list[int]) -> None:
    rows = _rows(Express().encode(start, mm, offsets, is_first=True))
    beams = Express().decode(rows, rows)
    assert beams.distance_mm[0].tolist() == mm
    assert (beams.offset_deg[0] * 8).tolist() == offsets
    assert [a.tolist() for a in start_angles_q6(Express(), rows)] == [[start], [True]]


@settings(max_examples=40, deadline=None)
@given(angle_q6, st.lists(st.integers(0, 65535), min_size=40, max_size=40))
def test_dense(start: int, mm: list[int]) -> None:
    rows = _rows(Dense().encode(start, mm))
    assert Dense().decode(rows, rows).distance_mm[0].tolist() == mm


@settings(max_examples=40, deadline=None)
@given(angle_q6, st.lists(st.integers(0, 65000), min_size=64, max_size=64), st.integers(0, 255))
def test_ultra_dense_is_as_fine_as_its_scales(start: int, mm: list[int], quality: int) -> None:
    rows = _rows(UltraDense().encode(start, mm, [quality] * 64))
    beams = UltraDense().decode(rows, rows)
    lost = np.array(mm) - beams.distance_mm[0]
    assert ((lost >= 0) & (lost < 6)).all()
    assert beams.quality is not None and (np.abs(beams.quality[0] - quality) < 8).all()


@settings(max_examples=40, deadline=None)
@given(st.lists(st.integers(60, 20000), min_size=33, max_size=33), st.integers(-60, 60))
def test_ultra_carries_three_beams_a_cabin(majors: list[int], bend: int) -> None:
    mm = [d for major in majors[:32] for d in (major, max(1, major + bend), max(1, major - bend))]
    this, following = Ultra().encode(0, mm, majors[32]), Ultra().encode(0, [majors[32]] * 96, majors[32])
    decoded = Ultra().decode(_rows(this), _rows(following)).distance_mm[0]
    assert (np.abs(decoded[0::3] - mm[0::3]) < 16).all()
    close = np.abs(np.array(mm[1::3]) - decoded[0::3]) < 400
    assert (np.abs(decoded[1::3] - mm[1::3])[close] <= 16).all(), "a beam near its major is told to the step"
    said = decoded[2::3] > 0  # a beam far from the next major cannot be told, and is not
    assert (np.abs(decoded[2::3] - mm[2::3])[said] <= 16).all()


def test_variable_bit_scale_as_a_public_client_has_it() -> None:
    coded = np.array([0x1E0, 0x20B, 0x219, 0x504, 0x507, 0x51E])
    mm, level = scale_up(coded)
    assert mm.tolist() == [0x1E0, 0x216, 0x232, 0x810, 0x81C, 0x878]
    assert level.tolist() == [0, 1, 1, 2, 2, 2]
    assert [scale_down(int(value)) for value in mm] == coded.tolist()


@pytest.mark.parametrize("kind", KINDS.values(), ids=lambda kind: f"{kind.type:#x}")
def test_a_flipped_bit_anywhere_is_refused_both_ways_of_judging(kind) -> None:
    args = (100, [1000] * kind.samples, 1000) if kind.type == 0x84 else (100, [1000] * kind.samples)
    capsule = kind.encode(*args)
    finder = frames_of(kind)
    for bit in range(0, 8 * len(capsule), 7):
        damaged = bytearray(capsule)
        damaged[bit // 8] ^= 1 << bit % 8
        for copies in (1, finder.MANY_FRAMES):  # one by one, and all at once
            window = ByteWindow(counters := Counters())
            window.push(bytes(damaged) * copies + capsule)
            taken = finder.take(window, counters)
            assert taken.data.tobytes() == capsule and counters.skipped_bytes == copies * len(capsule)


def test_hq_answers() -> None:
    angles = (350 + np.arange(96) * 0.3) % 360
    frame = rplidar_hq.encode(list(angles), list(np.arange(96) * 10.25))
    turn, mm, quality = rplidar_hq.decode(_rows(frame))
    assert np.allclose((turn[0] - angles + 180) % 360 - 180, 0, atol=0.003)
    assert mm[0].tolist() == (np.arange(96) * 10.25).tolist() and (quality == 47).all()
    assert rplidar_hq.is_good(frame) and not rplidar_hq.is_good(frame[:50] + b"\xff" + frame[51:])
