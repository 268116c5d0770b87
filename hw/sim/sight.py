"""What a range sensor sees from where it is: the part every simulated LIDAR shares, whatever bytes it speaks.

Sight       ranges along any bearings at any moments, with noise, from a moving or standing base
Turntable   a spinning head: which beams of which turn have been measured by now, and when each was
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from hw.sim.raycast import cast
from hw.sim.world import World
from protocol.geometry import SE2

Floats = NDArray[np.float64]
LATE_S = 0.5  # a host that did not look for longer missed the rest: a serial line keeps nothing


class PoseSource(Protocol):
    """Something that stands or moves in a world."""

    world: World

    def poses_at(self, times_s: Floats) -> Floats:
        """(N, 3 or more) x, y, theta at N moments."""
        ...


class Sight:
    """A range finder on a base.  `is_mirrored` turns it the wrong way round: proof that a check of its angles can fail."""

    def __init__(
        self, source: PoseSource, noise_m: float = 0.01, T_base_laser: SE2 | None = None, seed: int = 0, is_mirrored: bool = False
    ) -> None:
        self._source, self._noise_m, self._T_base_laser = source, noise_m, T_base_laser or SE2.identity()
        self._rng = np.random.default_rng([31, seed])
        self._sign = -1.0 if is_mirrored else 1.0

    def ranges_m(self, times_s: Floats, angles_rad: Floats, range_min_m: float, range_max_m: float) -> Floats:
        """(N,) along (N,) bearings of the laser frame, counter-clockwise; `inf` where nothing comes back."""
        poses, mount = self._source.poses_at(times_s), self._T_base_laser
        c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        origins = np.stack([poses[:, 0] + c * mount.x_m - s * mount.y_m, poses[:, 1] + s * mount.x_m + c * mount.y_m], axis=1)
        bearings = poses[:, 2] + mount.theta_rad + self._sign * angles_rad
        ranges_m, _ = cast(self._source.world.segments, origins, bearings, range_max_m)
        if self._noise_m > 0:
            ranges_m = ranges_m + self._noise_m * self._rng.standard_normal(len(ranges_m))
        return np.where((ranges_m >= range_min_m) & (ranges_m <= range_max_m), ranges_m, np.inf)

    def distances_mm(self, times_s: Floats, angles_rad: Floats, range_min_m: float, range_max_m: float) -> Floats:
        """The same in whole millimetres; 0 where nothing comes back, as most LIDARs say it."""
        ranges_m = self.ranges_m(times_s, angles_rad, range_min_m, range_max_m)
        is_return = np.isfinite(ranges_m)
        return np.where(is_return, np.rint(np.where(is_return, ranges_m, 0.0) * 1e3), 0.0)


@dataclass(frozen=True, slots=True)
class Part:
    """Some consecutive beams of one turn, all measured."""

    turn: int
    index: NDArray[np.int64]  # (n,) beam number within the turn
    times_s: Floats  # (n,)


class Turntable:
    """Beams at an even rate; each turn is cut in parts (first beam, one behind the last), handed out when measured."""

    def __init__(self, turn_hz: float, beams_per_turn: int, parts: Sequence[tuple[int, int]]) -> None:
        self.turn_hz, self.beams_per_turn, self._parts = turn_hz, beams_per_turn, list(parts)
        self._begun_s: float | None = None
        self._turn = self._part = 0

    @staticmethod
    def in_frames(turn_hz: float, beams_per_turn: int, beams_per_frame: int) -> Turntable:
        """Frames of so many beams, the last of a turn shorter where it must be."""
        edges = [*range(0, beams_per_turn, beams_per_frame), beams_per_turn]
        return Turntable(turn_hz, beams_per_turn, list(pairwise(edges)))

    def restart(self, now_s: float) -> None:
        """The head passes its zero now."""
        self._begun_s, self._turn, self._part = now_s, 0, 0

    def shift(self, turns: float) -> None:
        """A fault of the head: parts of a turn are missing (positive) or come again (negative)."""
        at = self._turn * len(self._parts) + self._part + round(turns * len(self._parts))
        self._turn, self._part = divmod(max(0, at), len(self._parts))
        if self._begun_s is not None:
            self._begun_s -= turns / self.turn_hz

    def due(self, now_s: float) -> list[Part]:
        """Parts measured since the last call, oldest first."""
        if self._begun_s is None or now_s - self._end_s() > LATE_S:
            self.restart(now_s)
        parts = []
        while (end_s := self._end_s()) <= now_s:
            first, last = self._parts[self._part]
            index = np.arange(first, last)
            per_s = self.turn_hz * self.beams_per_turn
            parts.append(Part(self._turn, index, end_s - (last - 1 - index) / per_s))
            self._turn, self._part = divmod(self._turn * len(self._parts) + self._part + 1, len(self._parts))
        return parts

    def _end_s(self) -> float:
        """When the last beam of the next part is measured."""
        assert self._begun_s is not None
        return self._begun_s + (self._turn + self._parts[self._part][1] / self.beams_per_turn) / self.turn_hz


def joined(parts: Sequence[Part]) -> tuple[Floats, Floats, list[int]]:
    """Beam numbers and moments of several parts in one row each, and where to split them again."""
    index = np.concatenate([part.index for part in parts]).astype(np.float64)
    times_s = np.concatenate([part.times_s for part in parts])
    return index, times_s, np.cumsum([len(part.index) for part in parts])[:-1].tolist()


def solve_angles(see: Sight, times_s: Floats, turn_deg: Floats, offset_deg: object, limits_m: tuple[float, float]) -> Floats:
    """Millimetres along beams whose true bearing depends on what they see, by iteration; 0 where no distance fits its own angle.

    `offset_deg(mm)` is what the host adds to the clockwise angle.
    """
    assert callable(offset_deg)
    mm = see.distances_mm(times_s, -np.radians(turn_deg), *limits_m)
    for _ in range(3):
        before = mm
        mm = see.distances_mm(times_s, -np.radians(turn_deg + offset_deg(mm)), *limits_m)
    return np.where(np.abs(mm - before) > 60, 0.0, mm)


def wrap_ms(seconds: float, period_ms: int) -> int:
    """A device clock in whole milliseconds."""
    return math.floor(seconds * 1e3) % period_ms
