"""Finding frames in a stream of bytes that may be wrong anywhere.

A decoder keeps a `ByteWindow`: what has arrived and is not yet understood, never more than `limit` bytes of it.  It looks
for a header, checks the frame behind it, and takes it.  After a bad frame the search goes on ONE byte after the false
header, because the true frame may begin inside the false one:

    .. 54 2C xx xx [54 2C .. good .. crc] ..
       ^ checksum fails: skip one byte, not 47

`fixed_frames` does this for many frames of one length at once: it judges every candidate position in numpy and then walks
over the good ones, which gives exactly what the byte-at-a-time search gives.
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
    is_skipping: bool = False

    def skip(self, n: int) -> None:
        """Count bytes that belong to no frame."""
        if n > 0:
            self.skipped_bytes += n
            self.is_skipping = True

    def good(self, n: int = 1) -> None:
        """Count good frames; the first one after skipped bytes is a resync."""
        self.frames += n
        if self.is_skipping:
            self.resyncs += 1
            self.is_skipping = False

    @property
    def trouble(self) -> int:
        """Everything that says the line is not clean; compare two readings of it."""
        return self.bad_frames + self.skipped_bytes + self.rejected


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
        if len(self._data) > self._limit:
            self.skip(len(self._data) - self._limit)

    def skip(self, n: int) -> None:
        """Drop n bytes that belong to no frame."""
        del self._data[:n]
        self._counters.skip(n)

    def take(self, n: int) -> bytes:
        """Remove n understood bytes and return them."""
        taken = bytes(self._data[:n])
        del self._data[:n]
        return taken

    def clear(self) -> None:
        """Forget everything, without counting it: the line was flushed."""
        self._data.clear()


Judge = Callable[[Bytes], NDArray[np.bool_]]  # (M, length) candidate frames -> which of them are good


def fixed_frames(
    window: ByteWindow, counters: Counters, header: bytes, length: int, judge: Judge
) -> tuple[Bytes, NDArray[np.int64]]:
    """Take all good frames of `length` bytes that start with `header`: (M, length) bytes, and (M,) bytes that followed each.

    What follows a frame tells how long before the end of this read it arrived.
    """
    data = np.frombuffer(bytes(window.data), dtype=np.uint8)
    n = len(data)
    if n < length:
        _skip_to_header(window, header)
        return np.empty((0, length), np.uint8), np.empty(0, np.int64)
    windows = np.lib.stride_tricks.sliding_window_view(data, length)
    is_candidate = windows[:, 0] == header[0]
    for i in range(1, len(header)):
        is_candidate &= windows[:, i] == header[i]
    candidates = np.flatnonzero(is_candidate)
    good = candidates[judge(windows[candidates])] if len(candidates) else candidates
    starts, end = chain(good, length)
    n_bad = int(np.count_nonzero(_outside(candidates, starts, length)))
    return _take(window, counters, windows, starts, end, n_bad, header, length)


def chain(good: NDArray[np.int64], length: int) -> tuple[NDArray[np.int64], int]:
    """Walk over good positions as the byte-at-a-time search does: each frame begins at or after the end of the one before."""
    if len(good) == 0:
        return good, 0
    if np.all(np.diff(good) >= length):
        return good, int(good[-1]) + length
    kept: list[int] = []
    end = 0
    for start in good.tolist():
        if start >= end:
            kept.append(start)
            end = start + length
    return np.array(kept, dtype=np.int64), end


def _outside(candidates: NDArray[np.int64], starts: NDArray[np.int64], length: int) -> NDArray[np.bool_]:
    """Which candidate headers lie in no good frame: those were tried and found bad."""
    if len(starts) == 0:
        return np.ones(len(candidates), dtype=bool)
    before = np.searchsorted(starts, candidates, side="right") - 1
    inside: NDArray[np.bool_] = (before >= 0) & (candidates - starts[np.maximum(before, 0)] < length)
    return ~inside


def _take(
    window: ByteWindow,
    counters: Counters,
    windows: Bytes,
    starts: NDArray[np.int64],
    end: int,
    n_bad: int,
    header: bytes,
    length: int,
) -> tuple[Bytes, NDArray[np.int64]]:
    n = len(window)
    frames = windows[starts]
    counters.bad_frames += n_bad
    gaps = np.diff(starts, prepend=-length) - length if len(starts) else np.empty(0, np.int64)
    counters.skipped_bytes += int(gaps.sum())
    counters.resyncs += int(np.count_nonzero(gaps[1:])) + int(len(gaps) > 0 and (counters.is_skipping or gaps[0] > 0))
    counters.frames += len(starts)
    if len(starts):
        counters.is_skipping = False
    window.take(end)
    judged_up_to = n - length + 1  # every position before this one had all its bytes and was judged
    window.skip(max(0, judged_up_to - end))
    _skip_to_header(window, header)
    return frames, n - (starts + length)


def _skip_to_header(window: ByteWindow, header: bytes) -> None:
    """Skip to the first position where a header may begin, keeping a header that is only half there."""
    data = window.data
    for k in range(len(header), 0, -1):
        at = data.find(header[:k]) if k == len(header) else (len(data) - k if data.endswith(header[:k]) else -1)
        if at >= 0:
            window.skip(at)
            return
    window.skip(len(data))
