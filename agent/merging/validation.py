"""What speaks for and against a transform, in metres of wall, seen from both maps."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from agent.features.field import DIRECTION_BINS, FREE_BYTE, MatchField
from agent.features.wall_points import SPACING_M, WallPoints
from agent.features.working import WorkingGrid
from agent.merging.result import MatchFactor
from agent.merging.scoring import AGREE_BINS, OPPOSITE_BINS, Probe, readings
from agent.merging.transforms import Poses, inverted

_NOTHING, _HIT, _CONFLICT, _CROSSING, _OPPOSITE = range(5)


def _kinds() -> NDArray[np.uint8]:
    byte, own = np.arange(256)[:, None], np.arange(DIRECTION_BINS)[None, :]
    apart = np.abs((byte - own + DIRECTION_BINS // 2) % DIRECTION_BINS - DIRECTION_BINS // 2)
    wall = np.where(apart <= AGREE_BINS, _HIT, np.where(apart < OPPOSITE_BINS, _CROSSING, _OPPOSITE))
    kinds = np.where(byte < DIRECTION_BINS, wall, np.where(byte == FREE_BYTE, _CONFLICT, _NOTHING))
    return kinds.astype(np.uint8).ravel()


KINDS = _kinds()


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """One row a transform; metres of wall, the mean of both directions."""

    agreeing_m: NDArray[np.float64]
    conflicting_m: NDArray[np.float64]
    crossing_m: NDArray[np.float64]
    observability_m: NDArray[np.float64]  # smallest eigenvalue of the sum of n n' over agreeing wall, the worse direction

    def score(self, conflict_weight: float = 2.0, crossing_weight: float = 0.3) -> NDArray[np.float64]:
        return self.agreeing_m - conflict_weight * self.conflicting_m - crossing_weight * self.crossing_m


@dataclass(frozen=True, slots=True, eq=False)
class Witness:
    """What judging needs of one map."""

    thin: WallPoints
    probe: Probe
    field: MatchField


def evidence(ours: Witness, theirs: Witness, poses: Poses) -> Evidence:
    """For and against every transform."""
    forth = _one_way(theirs, ours, poses)
    back = _one_way(ours, theirs, inverted(poses))
    agreeing, conflicting, crossing = (0.5 * (forth[k] + back[k]) for k in range(3))
    return Evidence(agreeing, conflicting, crossing, np.minimum(forth[3], back[3]))


def _one_way(points: Witness, on: Witness, poses: Poses) -> tuple[NDArray[np.float64], ...]:
    kinds = KINDS.take(readings(on.field.fine, on.field.resolution_m, points.probe, poses))
    hit = (kinds == _HIT).astype(np.float32)
    n = points.thin.normals
    xx, yy, xy = hit @ (n[:, 0] ** 2), hit @ (n[:, 1] ** 2), hit @ (n[:, 0] * n[:, 1])
    smallest = 0.5 * (xx + yy) - np.hypot(0.5 * (xx - yy), xy)
    counts = [hit.sum(axis=1), (kinds == _CONFLICT).sum(axis=1), (kinds == _CROSSING).sum(axis=1)]
    return tuple(np.asarray(v, np.float64) * SPACING_M for v in (*counts, smallest))


def match_factor(ours: WorkingGrid, theirs: WorkingGrid, pose: NDArray[np.float64]) -> tuple[MatchFactor, float]:
    """Equations (1) to (3) on the working grids, and the common area in square metres."""
    a, b = _trinary(ours), _trinary(theirs)
    c, s = np.cos(pose[2]), np.sin(pose[2])
    x, y = pose[:2]
    ra, rb = ours.resolution_m, theirs.resolution_m
    half = 0.5 * ra
    # our pixel centre -> metres -> their frame -> their pixel
    M = np.array(
        [
            [c * ra, s * ra, c * (half - x) + s * (half - y)],
            [-s * ra, c * ra, -s * (half - x) + c * (half - y)],
        ]
    ) / rb - np.array([[0, 0, 0.5], [0, 0, 0.5]])
    seen = cv2.warpAffine(b, M, (a.shape[1], a.shape[0]), flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP, borderValue=0)
    both = (a > 0) & (seen > 0)
    agree = int(np.count_nonzero(both & (a == seen)))
    known = int(np.count_nonzero(both))
    return MatchFactor(agree, known - agree), known * ra * ra


def _trinary(grid: WorkingGrid) -> NDArray[np.uint8]:
    return grid.free + 2 * grid.occupied
