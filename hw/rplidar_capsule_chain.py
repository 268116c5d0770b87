"""Capsules of an RPLIDAR in a row: each tells where its beams begin, and only the next one where they end (SERIAL.md 1.7).

A capsule is believed when its follower stands right behind it and the two are as far apart as the motor turns meanwhile.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hw.arrays import Bytes, Floats, Ints
from hw.byte_window import Counters
from hw.rplidar_capsules import CapsuleKind, start_angles_q6
from hw.scan_assembler import Beams
from hw.spinning import STRICT_ABOVE, carried

CIRCLE_Q6 = 360 * 64
MOST_HZ = 100.0  # a capsule that spans more of the circle than this speed allows is not one
LOOSE_SPAN, STRICT_SPAN = 0.05, 0.015  # real capsules differ by 1 to 2 % (SERIAL.md 1.7); on a bad line some of them are given up
NEW_SPEED_AFTER = 4  # so many strange spans in a row are a new speed


class CapsuleChain:
    """Decodes capsules of one stream; the newest waits for its follower."""

    def __init__(self, counters: Counters) -> None:
        self._counters = counters
        self.restart()

    def restart(self) -> None:
        """The stream begins anew."""
        self._last: Bytes | None = None
        self._last_gap, self._last_arrival_s = 0, 0.0
        self._usual_span_q6, self._strange_spans = 0.0, 0

    def beams(self, kind: CapsuleKind, frames: Bytes, gaps: Ints, arrivals_s: Floats, byte_s: float, period_s: float) -> Beams:
        """Beams of all capsules whose follower is here."""
        if self._last is not None:
            frames = np.concatenate([self._last, frames])
            gaps = np.concatenate([[self._last_gap], gaps])
            arrivals_s = np.concatenate([[self._last_arrival_s], arrivals_s])
        self._last, self._last_gap, self._last_arrival_s = frames[-1:], int(gaps[-1]), float(arrivals_s[-1])
        start_q6, is_first = start_angles_q6(kind, frames)
        span_q6 = np.diff(start_q6) % CIRCLE_Q6
        tolerance = STRICT_SPAN if float(np.mean(gaps > 0)) > STRICT_ABOVE else LOOSE_SPAN
        is_true = self._are_true(kind, span_q6, start_q6[:-1], (gaps[1:] == 0) & ~is_first[1:], tolerance)
        beams = kind.decode(frames[:-1][is_true], frames[1:][is_true])
        n = kind.samples
        span_deg, start_deg = span_q6[is_true] / 64.0, start_q6[:-1][is_true] / 64.0
        turn_deg = (start_deg[:, None] + span_deg[:, None] * (np.arange(n) / n)) % 360.0
        sample_s = span_deg / 360.0 * period_s / n
        stamps_s = (arrivals_s[:-1][is_true] - kind.length * byte_s)[:, None] - sample_s[:, None] * np.arange(n - 1, -1, -1)
        dirty = carried((gaps[:-1] > 0) | ~is_true, is_true)
        mm = beams.distance_mm
        return Beams(
            turn_deg=turn_deg.ravel(),
            angles_rad=-np.radians(turn_deg - beams.offset_deg).ravel(),
            ranges_m=np.where(mm == 0, np.nan, mm / 1e3).ravel(),
            stamps_s=stamps_s.ravel(),
            intensities=None if beams.quality is None else beams.quality.ravel(),
            is_dirty=np.repeat(dirty, n),
        )

    def _are_true(
        self, kind: CapsuleKind, span_q6: Ints, start_q6: Ints, is_next: NDArray[np.bool_], tolerance: float
    ) -> NDArray[np.bool_]:
        """Which capsules are followed by their own follower: no byte between, and the span the motor's speed makes."""
        most_q6 = MOST_HZ * 360 * 64 * kind.samples * 500e-6  # no RPLIDAR takes longer than 500 us for a sample
        can_be = is_next & (span_q6 > 0) & (span_q6 < min(most_q6, 180 * 64)) & (start_q6 < CIRCLE_Q6)
        is_true = np.zeros_like(can_be)
        for k in np.flatnonzero(can_be).tolist():
            change = abs(span_q6[k] - self._usual_span_q6)
            is_true[k] = change <= tolerance * self._usual_span_q6 + 2
            self._strange_spans = 0 if is_true[k] else self._strange_spans + 1
            if is_true[k]:
                self._usual_span_q6 += 0.2 * (span_q6[k] - self._usual_span_q6)
            elif self._strange_spans >= NEW_SPEED_AFTER or not self._usual_span_q6:  # the motor was set to another speed
                self._usual_span_q6, self._strange_spans = float(span_q6[k]), 0
        self._counters.rejected += int(np.count_nonzero(can_be & ~is_true))
        return is_true
