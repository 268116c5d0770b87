"""What has arrived on a line and is not yet understood, and what happened on the line so far.

A decoder keeps a `ByteWindow`, never more than `limit` bytes of it.  Each byte leaves it once: taken in a good frame, or skipped.
"""

from __future__ import annotations

from dataclasses import dataclass


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

    def skip_to(self, header: bytes, mask: bytes | None = None) -> None:
        """Skip to the first position where `header` may begin, keeping one that is half there; `mask`: its fixed bits."""
        self.skip(self._find(header) if mask is None else self._find_masked(header, mask))

    def _find(self, header: bytes) -> int:
        at = self._data.find(header)
        if at >= 0:
            return at
        half = next((k for k in range(len(header) - 1, 0, -1) if self._data.endswith(header[:k])), 0)
        return len(self._data) - half

    def _find_masked(self, header: bytes, mask: bytes) -> int:
        data, n = self._data, len(self._data)
        for at in range(n):
            if all(at + k >= n or data[at + k] & mask[k] == header[k] for k in range(len(header))):
                return at
        return n

    def clear(self) -> None:
        """Forget everything, without counting it: the line was flushed."""
        self._data.clear()
