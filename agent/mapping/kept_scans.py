"""Scans kept so that a map can be drawn again: each as small as it goes, and no more of a place than drawing needs.

A place is half a metre of floor, looked at in one of eight directions; of a LIDAR that looks all round, three quarters of a
metre and whatever the heading.  A robot that stands still or comes by again and again leaves there the first scan, which old
loops are recognised by, and the last two, which show how things are now: three are enough to make a cell free or occupied.
So what is kept grows with the ground driven over, not with time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent.mapping.scan_matching import Poses
from agent.mapping.scan_points import ScanPoints

PLACE_M, ALL_ROUND_PLACE_M = 0.5, 0.75
DIRECTIONS = 8
LAST_KEPT = 2  # of a place, beside the first
NEVER_THINNED = 100  # newest keyframes: the stretch that loops are looked for with
FEWEST_TO_THIN = 512
THIN_AGAIN = 1.25  # times as many as the last thinning left
LARGEST_UNIT = np.iinfo(np.int16).max


@dataclass(frozen=True, slots=True, eq=False)
class KeptScan:
    """What drawing a keyframe again needs: 1.5 KB at 360 beams, to a millimetre at 30 metres."""

    ends: NDArray[np.int16]  # (N, 2) ray ends, robot frame, in units
    unit_m: float
    hit_bits: NDArray[np.uint8]  # packed
    is_partial: bool
    is_all_round: bool

    @staticmethod
    def of(points: ScanPoints) -> KeptScan:
        unit_m = max(float(np.abs(points.points_m).max(initial=0.0)), 1e-3) / LARGEST_UNIT
        ends = np.round(points.points_m / unit_m).astype(np.int16)
        return KeptScan(ends, unit_m, np.packbits(points.is_hit), points.is_partial, points.is_all_round)

    @property
    def points_m(self) -> NDArray[np.float32]:
        """(N, 2) ray ends, robot frame."""
        return self.ends.astype(np.float32) * np.float32(self.unit_m)

    @property
    def is_hit(self) -> NDArray[np.bool_]:
        """(N,)"""
        return np.unpackbits(self.hit_bits, count=len(self.ends)).astype(bool)

    @property
    def nbytes(self) -> int:
        return self.ends.nbytes + self.hit_bits.nbytes


def needless(poses: Poses, is_all_round: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which of (K, 3) keyframes, in order of time, drawing can do without; (K,) says what their LIDAR saw."""
    x, y, theta = poses.T
    side_m = np.where(is_all_round, ALL_ROUND_PLACE_M, PLACE_M)
    direction = np.where(is_all_round, DIRECTIONS, np.round(theta * (DIRECTIONS / math.tau)) % DIRECTIONS)
    places = np.stack([np.floor(x / side_m), np.floor(y / side_m), direction])
    _, place, visits = np.unique(places, axis=1, return_inverse=True, return_counts=True)
    place = place.ravel()
    order = np.argsort(place, kind="stable")
    nth = np.empty(len(poses), np.int64)  # visit to its place
    nth[order] = np.arange(len(poses)) - np.repeat(np.cumsum(visits) - visits, visits)
    return np.asarray((nth > 0) & (nth < visits[place] - LAST_KEPT))
