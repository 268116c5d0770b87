"""Finding frames in a stream of bytes that may be wrong anywhere.

A decoder looks in its `ByteWindow` for a header, checks the frame behind it, and takes it.  After a bad frame the search goes
on ONE byte after the false header, because the true frame may begin inside the false one:

    .. 54 2C xx xx [54 2C .. good .. crc] ..
       ^ checksum fails: skip one byte, not 47

`SizedFrames` does this for frames that tell their own length, `FixedFrames` for frames of one length.  There much at once is
judged at every candidate position in numpy, which then walks over the good ones: exactly the same frames, sixty times faster.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hw.arrays import Bytes, Ints
from hw.byte_window import ByteWindow, Counters


@dataclass(frozen=True, slots=True)
class Frames:
    """Good frames in the order they came."""

    data: Bytes  # (M, length)
    behind: Ints  # (M,) bytes of the same read that came after the frame: how long ago it arrived
    gap: Ints  # (M,) bytes skipped right before the frame: not 0 on a line that is not clean

    def __len__(self) -> int:
        return len(self.data)


class SizedFrames:
    """Takes frames that tell their own length; they are handed on in rows of one length, padded with zeros."""

    def __init__(
        self,
        header: bytes,
        head_bytes: int,
        most_bytes: int,
        size: Callable[[bytearray], int],
        judge: Callable[[bytes], bool],
        header_mask: bytes | None = None,
    ) -> None:
        self._header, self._mask, self._head_bytes, self._most = header, header_mask, head_bytes, most_bytes
        self._size = size  # of the frame at the front of the window, from its first `head_bytes`; 0: it is none
        self._judge = judge

    def take(self, window: ByteWindow, counters: Counters) -> Frames:
        """All good frames that are complete; what cannot begin a frame is skipped and counted."""
        taken: list[bytes] = []
        left: list[int] = []
        gaps: list[int] = []
        while True:
            window.skip_to(self._header, self._mask)
            if len(window) < self._head_bytes:
                break
            size = self._size(window.data)
            if size and len(window) < size:
                break
            frame = bytes(window.data[:size])
            if size and self._judge(frame):
                window.take(size)
                taken.append(frame.ljust(self._most, b"\0"))
                left.append(len(window))
                gaps.append(counters.good())
            else:
                counters.bad_frames += 1
                window.skip(1)
        window.trim()
        data = np.frombuffer(b"".join(taken), np.uint8).reshape(-1, self._most)
        return Frames(data, np.array(left, np.int64), np.array(gaps, np.int64))


class FixedFrames:
    """Takes frames of one length and header out of a window; `judge` says which candidates are good."""

    MANY_FRAMES = 24  # from this many on numpy is faster than the loop (tests/bench/lidar_cpu.py)

    def __init__(
        self,
        header: bytes,
        length: int,
        judge: Callable[[bytes], bool],
        judge_many: Callable[[Bytes], NDArray[np.bool_]],  # (M, length) -> (M,)
        header_mask: bytes | None = None,
    ) -> None:
        self.length = length
        self._header, self._judge_many = header, judge_many
        self._mask = header_mask  # for headers of which only some bits are fixed
        self._one_by_one = SizedFrames(header, length, length, lambda _: length, judge, header_mask)

    def take(self, window: ByteWindow, counters: Counters) -> Frames:
        """All good frames that are complete; what cannot begin a frame is skipped and counted."""
        if len(window) < self.MANY_FRAMES * self.length:
            return self._one_by_one.take(window, counters)
        frames = self._take_many(window, counters)
        window.trim()
        return frames

    def _take_many(self, window: ByteWindow, counters: Counters) -> Frames:
        n, length = len(window), self.length
        windows = np.lib.stride_tricks.sliding_window_view(np.frombuffer(bytes(window.data), np.uint8), length)
        candidates = self._candidates(windows)
        starts = chain(candidates[self._judge_many(windows[candidates])], length)
        end = int(starts[-1]) + length if len(starts) else 0
        gaps = np.diff(starts, prepend=-length) - length
        if len(starts):
            counters.skipped_bytes += int(gaps.sum())
            gaps[0] += counters.gap_bytes
            counters.gap_bytes = 0
        counters.bad_frames += _count_outside(candidates, starts, length)
        counters.resyncs += int(np.count_nonzero(gaps))
        counters.frames += len(starts)
        window.take(end)
        window.skip(n - length + 1 - end)  # every position before had all its bytes and was judged
        window.skip_to(self._header, self._mask)
        return Frames(windows[starts], n - (starts + length), gaps)

    def _candidates(self, windows: Bytes) -> Ints:
        is_candidate = np.ones(len(windows), dtype=bool)
        for i, value in enumerate(self._header):
            column = windows[:, i] if self._mask is None else windows[:, i] & self._mask[i]
            is_candidate &= column == value
        return np.flatnonzero(is_candidate)


def chain(good: Ints, length: int) -> Ints:
    """Walk over good positions as the byte-at-a-time search does: each frame begins at or after the end of the one before."""
    if len(good) < 2 or np.all(np.diff(good) >= length):
        return good
    kept: list[int] = []
    end = 0
    for start in good.tolist():
        if start >= end:
            kept.append(start)
            end = start + length
    return np.array(kept, dtype=np.int64)


def _count_outside(candidates: Ints, starts: Ints, length: int) -> int:
    """How many candidate headers lie in no good frame: those were tried and found bad."""
    if len(starts) == 0:
        return len(candidates)
    before = np.searchsorted(starts, candidates, side="right") - 1
    is_inside = (before >= 0) & (candidates - starts[np.maximum(before, 0)] < length)
    return int(np.count_nonzero(~is_inside))
