"""What speaks for and against a transform, in metres of wall, seen from both maps."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from agent.features.field import MatchField
from agent.features.structure import LOOSE
from agent.features.wall_points import SPACING_M, WallPoints
from agent.features.working import WorkingGrid
from agent.merging.result import MatchFactor
from agent.merging.scoring import (
    AGREES,
    CONFLICTS,
    CROSSES,
    Probe,
    Worths,
    outcome_table,
    readings,
)
from agent.merging.transforms import Poses, inverted

OUTCOMES = np.tile(outcome_table().ravel(), 4)
DECISION_WORTH: Worths = (
    (0.6, -0.05, 0.0, 0.0),  # loose
    (1.0, -1.1, -0.7, -0.5),  # attached
    (1.0, -1.6, -0.9, -0.5),  # short
    (0.65, -1.9, -1.2, -0.5),  # long
)


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """One row a transform; metres of wall, the mean of both directions."""

    score_m: NDArray[np.float64]  # for less against, weighed by what each point is part of
    potential_m: NDArray[np.float64]  # for alone
    agreeing_m: NDArray[np.float64]  # firm wall: everything but loose things
    against_m: NDArray[np.float64]  # firm wall on the other's free space or across its walls
    observability_m: NDArray[np.float64]  # smallest eigenvalue of the sum of n n' over agreeing wall, the worse direction


@dataclass(frozen=True, slots=True, eq=False)
class Witness:
    """What judging needs of one map."""

    walls: WallPoints  # all of them, as the field numbers them
    thin: WallPoints
    kinds: NDArray[np.uint8]
    probe: Probe
    field: MatchField
    worth: NDArray[np.float32]  # table of `DECISION_WORTH` on this field


def evidence(ours: Witness, theirs: Witness, poses: Poses) -> Evidence:
    """For and against every transform."""
    forth = _one_way(theirs, ours, poses)
    back = _one_way(ours, theirs, inverted(poses))
    score, potential, agreeing, against = (0.5 * (forth[k] + back[k]) for k in range(4))
    return Evidence(score, potential, agreeing, against, np.minimum(forth[4], back[4]))


def _one_way(points: Witness, on: Witness, poses: Poses) -> tuple[NDArray[np.float64], ...]:
    index = readings(on.field.fine, on.field.resolution_m, points.probe, poses)
    worth, outcome = on.worth.take(index), OUTCOMES.take(index)
    hit, firm = outcome == AGREES, (points.kinds != LOOSE).astype(np.float32)
    n, hits = points.thin.normals, hit.astype(np.float32)
    xx, yy, xy = hits @ (n[:, 0] ** 2), hits @ (n[:, 1] ** 2), hits @ (n[:, 0] * n[:, 1])
    smallest = 0.5 * (xx + yy) - np.hypot(0.5 * (xx - yy), xy)
    against = ((outcome == CONFLICTS) | (outcome == CROSSES)).astype(np.float32) @ firm
    sums = worth.sum(axis=1), (worth * hits).sum(axis=1), hits @ firm, against, smallest
    return tuple(np.asarray(v, np.float64) * SPACING_M for v in sums)


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
