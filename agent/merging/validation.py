"""What speaks for and against a transform, in metres of wall, seen from both maps."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from agent.features.field import MatchField
from agent.features.structure import ATTACHED, LOOSE, SHORT
from agent.features.wall_points import SPACING_M, WallPoints
from agent.features.working import WorkingGrid
from agent.merging.result import MatchFactor
from agent.merging.scoring import (
    AGREES,
    CONFLICTS,
    CROSSES,
    Probe,
    Worths,
    looked_up,
    outcome_table,
    placed,
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

FAR_OFF = 1e-3  # of the wall: a point so far off that turning about it is sliding does not count as one
DEEP_M = 0.45  # a wall this far from any of theirs, in their free space, is no misalignment


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


def doubts(ours: Witness, theirs: Witness, pose: NDArray[np.float64]) -> tuple[float, float, float]:
    """Signs of another place of the same kind.

    Attached wall that conflicts and straight wall deep in free space, per metre that agrees; then metres of agreeing wall
    that is not long.
    """
    attached, deep, distinct, agreeing = np.zeros(2), 0.0, 0.0, 0.0
    for points, on, T in ((theirs, ours, pose[None]), (ours, theirs, inverted(pose[None]))):
        outcome = OUTCOMES.take(readings(on.field.fine, on.field.resolution_m, points.probe, T))[0]
        clutter = points.kinds == ATTACHED
        attached += [np.count_nonzero(clutter & (outcome == what)) for what in (CONFLICTS, AGREES)]
        agrees = outcome == AGREES
        agreeing += np.count_nonzero((points.kinds != LOOSE) & agrees)
        distinct += np.count_nonzero(((points.kinds == ATTACHED) | (points.kinds == SHORT)) & agrees)
        alone = (points.kinds >= SHORT) & (outcome == CONFLICTS)
        x, y = placed(points.probe.xy1[:, alone], T, on.field.resolution_m)
        away = looked_up(on.field.distance_m, x, y, outside=0)
        deep += np.count_nonzero(away > DEEP_M)
    agreeing = max(agreeing, 0.5)
    return float(attached[0] / max(attached[1], 0.5)), float(deep / agreeing), 0.5 * SPACING_M * float(distinct)


def turning(ours: Witness, theirs: Witness, pose: NDArray[np.float64]) -> float:
    """Metres of agreeing wall that say how the maps are turned, about whichever point says least; the worse direction.

    A round hall agrees with itself however it is turned about its middle.  Each point counts by how much of its way, were
    the map turned about that point, is along its normal.
    """
    least = math.inf
    for points, on, T in ((theirs, ours, pose[None]), (ours, theirs, inverted(pose[None]))):
        agrees = OUTCOMES.take(readings(on.field.fine, on.field.resolution_m, points.probe, T))[0] == AGREES
        n, at = (values[agrees].astype(np.float64) for values in (points.thin.normals, points.thin.positions_m))
        if not len(n):
            return 0.0
        at -= at.mean(axis=0)
        swept = at[:, 0] * n[:, 1] - at[:, 1] * n[:, 0]  # along the normals, turned about the middle
        moved = -np.linalg.solve(n.T @ n + FAR_OFF * len(n) * np.eye(2), n.T @ swept)  # and what undoes most of that
        way = moved @ moved + np.mean(np.sum(at**2, axis=1)) + 1e-9
        least = min(least, SPACING_M * float(np.sum((swept + n @ moved) ** 2) / way))
    return least


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
