"""What LIDARs with a turning head share: frames are held until a revolution ends, then decoded together.

Decoding a whole revolution in numpy costs a tenth of decoding each frame as it comes, and a scan cannot be handed on
earlier anyway.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hw.arrays import Bytes, Floats, Ints
from hw.byte_window import ByteWindow
from hw.driver import DriverBase, Reading
from hw.framing import FixedFrames, Frames, SizedFrames
from hw.scan_assembler import Beams, ScanAssembler

PACE_S = 1.0  # over how long the true rate of bytes is measured
PACE_GAP_S = 0.2  # a longer silence is no pace
STRICT_ABOVE = 0.02  # share of frames with damage before them from which angles must fit closely, as quiet devices' do
HOLD_AT_MOST = 256  # frames: bounds delay and memory when no revolution ends


class Pace:
    """Seconds a byte, as they really come.

    Frames that were read together are dated back from the newest by this, not by the line's rate: a device makes its
    frames at its own pace, however fast the line then carries them.
    """

    def __init__(self) -> None:
        self._marks: deque[tuple[float, int]] = deque()  # (time, bytes until then)
        self._total = 0

    def add(self, now_s: float, n: int) -> None:
        """n bytes came."""
        if self._marks and not 0 <= now_s - self._marks[-1][0] < PACE_GAP_S:
            self._marks.clear()
        self._total += n
        self._marks.append((now_s, self._total))
        while now_s - self._marks[0][0] > PACE_S:
            self._marks.popleft()

    def byte_s(self, least_s: float) -> float:
        """Seconds a byte; `least_s`, the line's own, as long as too little was seen."""
        (first_s, first), (last_s, last) = self._marks[0], self._marks[-1]
        if last_s - first_s < PACE_S / 10:
            return least_s
        return max(least_s, (last_s - first_s) / (last - first))


@dataclass(frozen=True, slots=True)
class _Waiting:
    """The last frame, which waits for the next one to bear it out."""

    data: Bytes
    gaps: Ints
    arrivals_s: Floats
    follows: bool  # from the frame before it


class SpinningLidar(DriverBase):
    """A `Driver` but for the protocol: `_find`, `_is_turn` and `_beams` are its own."""

    doubts_before_gap = False  # a frame that lost bytes is filled up with the next one's, and that leaves a gap behind it

    def __init__(self, range_min_m: float, range_max_m: float) -> None:
        super().__init__()
        self._window = ByteWindow(self.counters)
        self._assembler = ScanAssembler(range_min_m, range_max_m)
        self._held: list[Frames] = []
        self._held_arrivals_s: list[Floats] = []
        self._due = 0
        self._is_strict = False
        self._last: _Waiting | None = None
        self._pace = Pace()

    @property
    def coverage(self) -> float:
        """Of the last scan."""
        return self._assembler.coverage

    @property
    def range_min_m(self) -> float:
        """Nearest range that is believed."""
        return self._assembler.range_min_m

    @property
    def range_max_m(self) -> float:
        """Farthest range that is believed."""
        return self._assembler.range_max_m

    def limit(self, range_min_m: float, range_max_m: float) -> None:
        """Believe only ranges within these limits."""
        self._assembler.range_min_m, self._assembler.range_max_m = range_min_m, range_max_m

    def restart(self) -> None:
        """See `Driver.restart`."""
        self._window.clear()
        self._assembler.restart()
        self._drop_held()
        self._last = None

    def feed(self, data: bytes, now_s: float) -> list[Reading]:
        """See `Driver.feed`."""
        raise NotImplementedError

    def _arrive(self, data: bytes, now_s: float) -> None:
        self._window.push(data)
        self._pace.add(now_s, len(data))

    def _drop_held(self) -> None:
        self._held.clear()
        self._held_arrivals_s.clear()
        self._due = 0

    def _hold(self, frames: Frames, now_s: float, is_turn: bool) -> list[Reading]:
        """Keep these frames; decode what is kept when a revolution ends, and once more when its last frame has its witness."""
        if len(frames) == 0:
            return []
        self._held.append(frames)
        self._held_arrivals_s.append(now_s - frames.behind.astype(np.float64) * self._pace.byte_s(10.0 / self.baud))
        self._due = 2 if is_turn else self._due
        if not self._due and sum(map(len, self._held)) < HOLD_AT_MOST:
            return []
        self._due = max(0, self._due - 1)
        data = np.concatenate([held.data for held in self._held])
        gaps = np.concatenate([held.gap for held in self._held])
        arrivals_s = np.concatenate(self._held_arrivals_s)
        self._drop_held()
        believed = self._witnessed(data, gaps, arrivals_s)
        if len(believed[0]) == 0:
            return []
        scans = self._assembler.add(self._beams(*believed))
        self.period_s = self._assembler.period_s
        return list(scans)

    def _witnessed(self, data: Bytes, gaps: Ints, arrivals_s: Floats) -> tuple[Bytes, Ints, Floats]:
        """The frames that fit the frame before or behind them; the last one waits for the next.

        A damaged frame that passes its checksum is put in the wrong place if its angle is what was damaged.  Frames follow
        one another without a byte between, each where the one before ended, so a frame that does neither is not believed.
        """
        if self._last is not None:
            data, gaps = np.concatenate([self._last.data, data]), np.concatenate([self._last.gaps, gaps])
            arrivals_s = np.concatenate([self._last.arrivals_s, arrivals_s])
        self._is_strict = float(np.mean(gaps > 0)) > STRICT_ABOVE
        follows = np.concatenate(
            [[self._last is not None and self._last.follows], self._follow(data, self._is_strict) & (gaps[1:] == 0)]
        )
        self._last = _Waiting(data[-1:], gaps[-1:], arrivals_s[-1:], bool(follows[-1]))
        is_seen = follows[:-1] | follows[1:]
        if self.doubts_before_gap:
            is_seen &= gaps[1:] == 0
        self.counters.rejected += int(np.count_nonzero(~is_seen))
        dirty = carried((gaps[:-1] > 0) | ~is_seen, is_seen)
        return data[:-1][is_seen], dirty.astype(np.int64), arrivals_s[:-1][is_seen]

    def _follow(self, data: Bytes, is_strict: bool) -> NDArray[np.bool_]:
        """Which frames begin where the one before ended: (M,) frames to (M - 1,); strictly on a line that is not clean."""
        raise NotImplementedError

    def _beams(self, frames: Bytes, gaps: Ints, arrivals_s: Floats) -> Beams:
        """What frames say, with the bytes skipped before each and the time each arrived."""
        raise NotImplementedError


class FixedFrameLidar(SpinningLidar):
    """A spinning LIDAR that sends frames of one kind only."""

    frames: FixedFrames | SizedFrames

    def feed(self, data: bytes, now_s: float) -> list[Reading]:
        """Scans that these bytes complete."""
        self._arrive(data, now_s)
        frames = self.frames.take(self._window, self.counters)
        return self._hold(frames, now_s, len(frames) > 0 and self._is_turn(frames))

    def _is_turn(self, frames: Frames) -> bool:
        """Does a revolution end in these frames?  A wrong yes costs a little time, nothing else."""
        raise NotImplementedError


def carried(dirty: NDArray[np.bool_], kept: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Dirt of frames that are dropped moves on to the next frame kept: (M,) of all to (K,) of the kept."""
    if kept.all():
        return dirty
    following: NDArray[np.int64] = np.cumsum(kept) - kept  # index among the kept of the frame at or after each
    moved = np.zeros(int(kept.sum()) + 1, bool)
    np.logical_or.at(moved, following, dirty)
    return moved[:-1]
