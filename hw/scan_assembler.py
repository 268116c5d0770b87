"""Beams in, whole revolutions out.

A spinning LIDAR sends packets of a few beams; a scan is cut where its own angle passes zero, and only revolutions seen from
cut to cut are handed on.  What was not seen makes the revolution partial:

    packet packet | packet packet  (lost)  packet packet | packet ...
          never   |<---- one scan, coverage 0.9: partial ----->|

On a line that is not clean an 8-bit checksum lets one damaged packet in 256 through (an XOR lets two equal flips through).
So in a revolution with damage around it, or often before it, a beam stands only when it lies midway between its two
neighbours and between the two behind them, as it does on a wall, give or take the noise; all others are invalid.  (Asking the
next two only let 9 of 3.4 million scans of an LD06 through: a pair damaged alike, a value that cut a corner.)  On a clean line
nothing is filtered.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hw.arrays import Floats, median
from hw.readings import LaserScan

FULL_COVERAGE = 0.95  # issue D: below, a scan is partial and never clears free space
LEAST_COVERAGE = 0.25  # below, a revolution is not worth handing on
LONGEST_HOLE = 0.45  # share of a revolution: after a longer hole its cut cannot be told from the next one's
LEAST_PERIOD_S, MOST_PERIOD_S = 0.03, 2.0  # 30 turns a second to one in two
MEMORY_TURNS, OFTEN_DIRTY = 20, 2  # a line that was damaged in two turns of twenty is not clean
MAX_BEAMS = 20000  # a stuck motor turns no more: its revolution never ends


@dataclass(frozen=True, slots=True)
class Beams:
    """Consecutive beams in the order they were measured."""

    turn_deg: Floats  # (N,) where the head was, 0..360, growing: only to cut by
    angles_rad: Floats  # (N,) of the beam, counter-clockwise, x forward
    ranges_m: Floats  # (N,) nan: invalid
    stamps_s: Floats  # (N,)
    intensities: Floats | None = None  # (N,)
    is_dirty: NDArray[np.bool_] | None = None  # (N,) bytes were lost or damaged right before it

    def __len__(self) -> int:
        return len(self.turn_deg)

    def part(self, where: slice) -> Beams:
        """Some of them."""
        return Beams(
            self.turn_deg[where],
            self.angles_rad[where],
            self.ranges_m[where],
            self.stamps_s[where],
            None if self.intensities is None else self.intensities[where],
            None if self.is_dirty is None else self.is_dirty[where],
        )


class ScanAssembler:
    """Collects beams and cuts them into scans."""

    def __init__(self, range_min_m: float, range_max_m: float) -> None:
        self.range_min_m, self.range_max_m = range_min_m, range_max_m
        self.period_s = 0.1  # of the last whole revolution
        self._hole_s = LONGEST_HOLE * self.period_s
        self.coverage = 0.0  # of the last scan
        self.witnesses = WITNESSES
        self._pending: list[Beams] = []
        self._pending_n = 0
        self._is_whole = False  # the pending beams begin at a cut
        self._last_turn_deg: float | None = None
        self._last_stamp_s = 0.0
        self._dirty_turns: deque[bool] = deque(maxlen=MEMORY_TURNS)  # the newest last

    def restart(self) -> None:
        """The stream begins anew: what is pending is part of a revolution that was never finished."""
        self._pending.clear()
        self._pending_n = 0
        self._is_whole = False
        self._last_turn_deg = None

    def add(self, beams: Beams) -> list[LaserScan]:
        """The scans these beams complete."""
        if len(beams) == 0:
            return []
        scans: list[LaserScan] = []
        begin = 0
        for cut, is_hole in self._cuts(beams):
            self._keep(beams.part(slice(begin, cut)))
            scan = None if is_hole else self._close()
            if scan is not None:
                scans.append(scan)
            self._pending.clear()
            self._pending_n, self._is_whole, begin = 0, not is_hole, cut
        self._keep(beams.part(slice(begin, len(beams))))
        return scans

    def _cuts(self, beams: Beams) -> list[tuple[int, bool]]:
        """Where a new revolution begins: the index, and whether too much is missing there to know."""
        first_turn_deg = beams.turn_deg[0] if self._last_turn_deg is None else self._last_turn_deg
        first_stamp_s = beams.stamps_s[0] if self._last_turn_deg is None else self._last_stamp_s
        step_deg = np.diff(beams.turn_deg, prepend=first_turn_deg)
        step_s = np.diff(beams.stamps_s, prepend=first_stamp_s)
        self._last_turn_deg, self._last_stamp_s = float(beams.turn_deg[-1]), float(beams.stamps_s[-1])
        is_hole = step_s > self._hole_s
        if is_hole.any():  # or the turn is slower than was thought: a wrong period must not make holes for ever
            self._hole_s = min(1.5 * self._hole_s, MOST_PERIOD_S)
        where = np.flatnonzero(is_hole | (step_deg < -180))
        return [(int(i), bool(is_hole[i])) for i in where]

    def _keep(self, beams: Beams) -> None:
        if len(beams):
            self._pending.append(beams)
            self._pending_n += len(beams)
        if self._pending_n > MAX_BEAMS:
            self.restart()

    def _close(self) -> LaserScan | None:
        """One revolution, from cut to cut; None when its beginning was not seen or hardly anything is in it."""
        if not self._is_whole or self._pending_n < 2:
            return None
        beams = _joined(self._pending)
        duration_s = float(beams.stamps_s[-1] - beams.stamps_s[0])
        if LEAST_PERIOD_S < duration_s < MOST_PERIOD_S:
            self.period_s = duration_s
            self._hole_s = LONGEST_HOLE * duration_s
        coverage = coverage_of(beams.turn_deg)
        is_dirty = beams.is_dirty is not None and bool(beams.is_dirty.any())
        self._dirty_turns.append(is_dirty)
        if coverage < LEAST_COVERAGE:
            return None
        self.coverage = coverage
        return self._scan(beams, coverage, self._is_suspect())

    def _is_suspect(self) -> bool:
        """Damage now, in the turn before, or more than once of late: altered bytes in a frame leave no gap to be seen by."""
        return any(list(self._dirty_turns)[-2:]) or sum(self._dirty_turns) >= OFTEN_DIRTY

    def _scan(self, beams: Beams, coverage: float, must_filter: bool) -> LaserScan:
        ranges_m = beams.ranges_m
        with np.errstate(invalid="ignore"):
            ranges_m = np.where(
                (ranges_m < self.range_min_m) | ((ranges_m > self.range_max_m) & np.isfinite(ranges_m)), np.nan, ranges_m
            )
        if must_filter:
            ranges_m = np.where(is_evenly_spaced(beams.angles_rad), supported_only(ranges_m, self.witnesses), np.nan)
        offsets_s = np.maximum.accumulate(beams.stamps_s - beams.stamps_s[0])
        return LaserScan(
            stamp_s=float(beams.stamps_s[0]),
            ranges_m=ranges_m.astype(np.float32),
            angles_rad=np.remainder(beams.angles_rad + np.pi, 2 * np.pi).astype(np.float32) - np.float32(np.pi),
            range_min_m=self.range_min_m,
            range_max_m=self.range_max_m,
            duration_s=float(offsets_s[-1]),
            intensities=None if beams.intensities is None else beams.intensities.astype(np.float32),
            time_offsets_s=offsets_s.astype(np.float32),
            is_partial=coverage < FULL_COVERAGE,
        )


def _joined(parts: list[Beams]) -> Beams:
    if len(parts) == 1:
        return parts[0]
    has_dirt = any(part.is_dirty is not None for part in parts)
    return Beams(
        np.concatenate([part.turn_deg for part in parts]),
        np.concatenate([part.angles_rad for part in parts]),
        np.concatenate([part.ranges_m for part in parts]),
        np.concatenate([part.stamps_s for part in parts]),
        None if parts[0].intensities is None else np.concatenate([p.intensities for p in parts if p.intensities is not None]),
        np.concatenate([np.zeros(len(p), bool) if p.is_dirty is None else p.is_dirty for p in parts]) if has_dirt else None,
    )


def coverage_of(turn_deg: Floats) -> float:
    """Share of the circle that the head was seen to pass: gaps longer than two usual steps are missing."""
    ordered = np.sort(turn_deg)
    gaps = _turned(ordered, -1) - ordered
    gaps[-1] += 360.0
    usual = median(gaps)
    long = gaps[gaps > 2.0 * max(usual, 0.05)]
    return 1.0 - float(long.sum() - usual * len(long)) / 360.0 if len(long) else 1.0


def _turned(values: Floats, steps: int) -> Floats:
    """`np.roll`, five times faster."""
    return np.concatenate((values[-steps:], values[:-steps]))


WITNESSES: tuple[int, ...] = (1, 2)  # which neighbours a beam must lie midway between
NOISE_M, NOISE_SHARE = 0.012, 0.003  # how far a beam may lie from the mean of its neighbours; a flipped bit moves it further
NEIGHBOURS_M, NEIGHBOURS_SHARE = 0.10, 0.05  # neighbours further apart than this are an edge: no witness


def supported_only(ranges_m: Floats, steps: tuple[int, ...] = WITNESSES) -> Floats:
    """The ranges that lie midway between both their neighbours, as beams on a wall do; the others become nan.

    `steps`: which neighbours are asked; a protocol that codes three beams by one number has all three wrong at once.
    """
    stands = np.ones(len(ranges_m), bool)
    with np.errstate(invalid="ignore"):
        for step in steps:
            before, after = _turned(ranges_m, step), _turned(ranges_m, -step)
            stands &= np.abs(before - after) <= step * (NEIGHBOURS_M + NEIGHBOURS_SHARE * ranges_m)
            stands &= np.abs(ranges_m - (before + after) / 2) <= NOISE_M + NOISE_SHARE * ranges_m
    return np.where(stands, ranges_m, np.nan)


UNEVEN_RAD = np.radians(0.13)  # one step of an express capsule's offsets; 1 cm at 5 m


def is_evenly_spaced(angles_rad: Floats, steps: tuple[int, ...] = (1, 3)) -> NDArray[np.bool_]:
    """Which beams lie midway between their neighbours in angle: where a device sends angles, they too can be damaged.

    Two neighbours damaged alike would bear one another out; the ones three steps away do not.
    """
    even = np.ones(len(angles_rad), bool)
    for step in steps:
        before = np.remainder(angles_rad - _turned(angles_rad, step) + np.pi, 2 * np.pi) - np.pi
        even &= np.abs(_turned(before, -step) - before) <= 2 * UNEVEN_RAD
    return even
