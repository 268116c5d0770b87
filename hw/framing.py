"""Finding frames in a stream of bytes that may be wrong anywhere.

A decoder keeps a `ByteWindow`: what has arrived and is not yet understood, never more than `limit` bytes of it.  It looks
for a header, checks the frame behind it, and takes it.  After a bad frame the search goes on ONE byte after the false
header, because the true frame may begin inside the false one:

    .. 54 2C xx xx [54 2C .. good .. crc] ..
       ^ checksum fails: skip one byte, not 47

`FixedFrames` does this for frames of one length.  A few bytes are searched byte by byte; much at once is judged at every
candidate position in numpy, which then walks over the good ones: exactly the same frames, sixty times faster.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]


@dataclass(slots=True)
class Counters:
    """What happened on one line since it was opened; only ever grows."""

    bytes_in: int = 0
    frames: int = 0  # good frames
    bad_frames: int = 0  # a header with a wrong checksum, length or content behind it
    skipped_bytes: int = 0  # bytes that belonged to no good frame
    resyncs: int = 0  # times a good frame came after skipped bytes
    rejected: int = 0  # frames with a good checksum and impossible content
    gap_bytes: int = 0  # skipped since the last good frame

    def skip(self, n: int) -> None:
        """Count bytes that belong to no frame."""
        self.skipped_bytes += n
        self.gap_bytes += n

    def good(self) -> int:
        """Count a good frame; the answer is how many bytes were skipped right before it."""
        gap, self.gap_bytes = self.gap_bytes, 0
        self.frames += 1
        self.resyncs += gap > 0
        return gap


class ByteWindow:
    """Bytes that have arrived and are not yet understood; the oldest are skipped when there are more than `limit`."""

    def __init__(self, counters: Counters, limit: int = 65536) -> None:
        self._data = bytearray()
        self._counters = counters
        self._limit = limit

    def __len__(self) -> int:
        return len(self._data)

    @property
    def data(self) -> bytearray:
        """The bytes themselves: to look at, not to keep."""
        return self._data

    def push(self, data: bytes) -> None:
        """Add what has arrived."""
        self._counters.bytes_in += len(data)
        self._data += data

    def trim(self) -> None:
        """Skip the oldest bytes beyond the limit; called when all that can be understood was taken."""
        if len(self._data) > self._limit:
            self.skip(len(self._data) - self._limit)

    def skip(self, n: int) -> None:
        """Drop n bytes that belong to no frame."""
        if n > 0:
            del self._data[:n]
            self._counters.skip(n)

    def take(self, n: int) -> bytes:
        """Remove n understood bytes and return them."""
        taken = bytes(self._data[:n])
        del self._data[:n]
        return taken

    def skip_to(self, header: bytes) -> None:
        """Skip to the first position where `header` may begin, keeping a header that is only half there."""
        at = self._data.find(header)
        if at < 0:
            half = next((k for k in range(len(header) - 1, 0, -1) if self._data.endswith(header[:k])), 0)
            at = len(self._data) - half
        self.skip(at)

    def clear(self) -> None:
        """Forget everything, without counting it: the line was flushed."""
        self._data.clear()


@dataclass(frozen=True, slots=True)
class Frames:
    """Good frames in the order they came."""

    data: Bytes  # (M, length)
    behind: NDArray[np.int64]  # (M,) bytes of the same read that came after the frame: how long ago it arrived
    gap: NDArray[np.int64]  # (M,) bytes skipped right before the frame: not 0 on a line that is not clean

    def __len__(self) -> int:
        return len(self.data)


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
        self._header, self._judge, self._judge_many = header, judge, judge_many
        self._mask = header_mask  # for headers of which only some bits are fixed

    def take(self, window: ByteWindow, counters: Counters) -> Frames:
        """All good frames that are complete; what cannot begin a frame is skipped and counted."""
        many = len(window) >= self.MANY_FRAMES * self.length
        frames = self._take_many(window, counters) if many else self._take_few(window, counters)
        window.trim()
        return frames

    def _take_few(self, window: ByteWindow, counters: Counters) -> Frames:
        taken: list[bytes] = []
        left: list[int] = []
        gaps: list[int] = []
        while True:
            self._skip_to_header(window)
            if len(window) < self.length:
                break
            frame = bytes(window.data[: self.length])
            if self._judge(frame):
                taken.append(window.take(self.length))
                left.append(len(window))
                gaps.append(counters.good())
            else:
                counters.bad_frames += 1
                window.skip(1)
        data = np.frombuffer(b"".join(taken), np.uint8).reshape(-1, self.length)
        return Frames(data, np.array(left, np.int64), np.array(gaps, np.int64))

    def _skip_to_header(self, window: ByteWindow) -> None:
        if self._mask is None:
            window.skip_to(self._header)
            return
        data, mask, header = window.data, self._mask, self._header
        n = len(data)
        for at in range(n):
            if all(at + k >= n or data[at + k] & mask[k] == header[k] for k in range(len(header))):
                window.skip(at)
                return
        window.skip(n)

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
        self._skip_to_header(window)
        return Frames(windows[starts], n - (starts + length), gaps)

    def _candidates(self, windows: Bytes) -> NDArray[np.int64]:
        is_candidate = np.ones(len(windows), dtype=bool)
        for i, value in enumerate(self._header):
            column = windows[:, i] if self._mask is None else windows[:, i] & self._mask[i]
            is_candidate &= column == value
        return np.flatnonzero(is_candidate)


class SizedFrames:
    """Takes frames that tell their own length; they are handed on in rows of one length, padded with zeros."""

    def __init__(
        self, header: bytes, head_bytes: int, most_bytes: int, size: Callable[[bytearray], int], judge: Callable[[bytes], bool]
    ) -> None:
        self._header, self._head_bytes, self._most = header, head_bytes, most_bytes
        self._size = size  # of the frame at the front of the window, from its first `head_bytes`; 0: it is none
        self._judge = judge

    def take(self, window: ByteWindow, counters: Counters) -> Frames:
        """All good frames that are complete; what cannot begin a frame is skipped and counted."""
        taken: list[bytes] = []
        left: list[int] = []
        gaps: list[int] = []
        while True:
            window.skip_to(self._header)
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


def chain(good: NDArray[np.int64], length: int) -> NDArray[np.int64]:
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


def _count_outside(candidates: NDArray[np.int64], starts: NDArray[np.int64], length: int) -> int:
    """How many candidate headers lie in no good frame: those were tried and found bad."""
    if len(starts) == 0:
        return len(candidates)
    before = np.searchsorted(starts, candidates, side="right") - 1
    is_inside = (before >= 0) & (candidates - starts[np.maximum(before, 0)] < length)
    return int(np.count_nonzero(~is_inside))


def median(values: NDArray[np.float64]) -> float:
    """The upper median, without the cost of `np.median`."""
    middle = len(values) // 2
    return float(np.partition(values, middle)[middle])
