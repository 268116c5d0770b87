"""Frames are found as the obvious byte-at-a-time search finds them, however the bytes come."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from hw.byte_window import ByteWindow, Counters
from hw.framing import FixedFrames, SizedFrames

LENGTH = 6


def _is_good(frame: bytes) -> bool:
    return sum(frame[:-1]) & 3 == frame[-1] & 3


def _are_good(frames: np.ndarray) -> np.ndarray:
    return frames[:, :-1].sum(axis=1) & 3 == frames[:, -1] & 3


def _obvious(data: bytes) -> list[bytes]:
    frames, at = [], 0
    while at + LENGTH <= len(data):
        frame = data[at : at + LENGTH]
        is_frame = frame[:2] == b"\x01\x02" and _is_good(frame)
        frames += [frame] if is_frame else []
        at += LENGTH if is_frame else 1
    return frames


def _finder(many_from: int, masked: bool = False) -> FixedFrames:
    mask = b"\xff\xff" if masked else None
    finder = FixedFrames(b"\x01\x02", LENGTH, _is_good, _are_good, mask)
    finder.MANY_FRAMES = many_from
    return finder


def _feed(finder: FixedFrames, parts: list[bytes]) -> tuple[list[bytes], list[int], Counters, ByteWindow]:
    counters = Counters()
    window = ByteWindow(counters)
    taken, gaps = [], []
    for part in parts:
        window.push(part)
        frames = finder.take(window, counters)
        taken += [row.tobytes() for row in frames.data]
        gaps += frames.gap.tolist()
    return taken, gaps, counters, window


noisy = st.lists(
    st.sampled_from([b"\x01", b"\x02", b"\x00", b"\x03", b"\x01\x02\x00\x00\x00\x03", b"\x01\x02\x01\x02\x00\x02"]), max_size=60
)


@settings(max_examples=150, deadline=None)
@given(noisy, st.integers(1, 40), st.booleans())
def test_every_way_of_searching_finds_the_frames_of_the_obvious_search(pieces: list[bytes], chunk: int, masked: bool) -> None:
    data = b"".join(pieces)
    parts = [data[i : i + chunk] for i in range(0, len(data), chunk)]
    few, few_gaps, few_counters, window = _feed(_finder(1000, masked), parts)
    many, many_gaps, many_counters, _ = _feed(_finder(1, masked), [data])
    assert few == many == _obvious(data)
    assert few_gaps == many_gaps
    assert few_counters == many_counters
    assert few_counters.bytes_in == LENGTH * len(few) + few_counters.skipped_bytes + len(window)


def test_the_true_frame_inside_a_false_one_is_found() -> None:
    good = b"\x01\x02\x00\x00\x00\x03"
    frames, gaps, counters, _ = _feed(_finder(1000), [b"\x01\x02\x00" + good])
    assert frames == [good]
    assert gaps == [3]
    assert (counters.bad_frames, counters.skipped_bytes, counters.resyncs) == (1, 3, 1)


def test_a_window_never_grows_without_bound() -> None:
    counters = Counters()
    window = ByteWindow(counters, limit=100)
    finder = SizedFrames(b"\x01", 2, 200, lambda _: 150, lambda _: True)
    for _ in range(50):
        window.push(b"\x01" * 99)
        finder.take(window, counters)
        assert len(window) <= 150
    assert counters.bytes_in == 50 * 99


def test_bytes_behind_a_frame_tell_how_long_ago_it_came() -> None:
    good = b"\x01\x02\x00\x00\x00\x03"
    counters = Counters()
    window = ByteWindow(counters)
    window.push(good * 3 + b"\x01")
    for finder in (_finder(1000), _finder(1)):
        window.clear()
        window.push(good * 3 + b"\x01")
        assert finder.take(window, counters).behind.tolist() == [13, 7, 1]
