"""Signs of another place of the same kind: what a building does not repeat, and what no misalignment explains."""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from agent.features.structure import ATTACHED, LONG, LOOSE, SHORT
from agent.features.wall_points import SPACING_M
from agent.merging.scoring import AGREES, CONFLICTS, looked_up, placed, readings
from agent.merging.transforms import inverted
from agent.merging.validation import OUTCOMES, Witness

DEEP_M = 0.45  # a wall this far from any of theirs, in their free space, is no misalignment
LINK_M = 0.5  # points of one wall are nearer to each other than two cells of this size
FAR_OFF = 1e-3  # of the wall: a point so far off that turning about it is sliding does not count as one


class Doubts(NamedTuple):
    """Of one transform; metres are the mean of both directions."""

    attached: float  # attached wall that conflicts, per metre of it that agrees
    deep: float  # straight wall deep in free space, per metre of firm wall that agrees
    distinct_m: float  # agreeing wall that is no long wall
    stretch_m: float  # the most of one long wall that stands deep in the other map's free space
    loose_m: float  # of free-standing things that agree,
    astray_m: float  # and that stand deep in free space


def doubts(ours: Witness, theirs: Witness, pose: NDArray[np.float64]) -> Doubts:
    """What both maps say against this being one place."""
    forth, back = _counted(theirs, ours, pose[None]), _counted(ours, theirs, inverted(pose[None]))
    attached, conflicting, agreeing, deep, distinct, loose, astray = (float(n) for n in (forth + back)[:-1])
    half_m = 0.5 * SPACING_M
    return Doubts(
        conflicting / max(attached, 0.5),
        deep / max(agreeing, 0.5),
        half_m * distinct,
        SPACING_M * float(max(forth[-1], back[-1])),
        half_m * loose,
        half_m * astray,
    )


def _counted(points: Witness, on: Witness, poses: NDArray[np.float64]) -> NDArray[np.int64]:
    """(8,) points of one map, seen by the other: what `doubts` adds up, and last the largest piece of long wall."""
    kinds, outcome = points.kinds, outcome_on(points, on, poses)
    agrees, conflicts = outcome == AGREES, outcome == CONFLICTS
    deep = np.flatnonzero(conflicts)
    x, y = placed(points.probe.xy1[:, deep], poses, on.field.resolution_m)
    deep = deep[looked_up(on.field.distance_m, x, y, outside=0).ravel() > DEEP_M]
    attached, loose = kinds == ATTACHED, kinds == LOOSE
    all_of = (
        attached & agrees,
        attached & conflicts,
        ~loose & agrees,
        kinds[deep] >= SHORT,
        (attached | (kinds == SHORT)) & agrees,
        loose & agrees,
        loose[deep],
    )
    return np.array([*map(np.count_nonzero, all_of), _largest_piece(points.thin.positions_m[deep[kinds[deep] == LONG]])])


def outcome_on(points: Witness, on: Witness, poses: NDArray[np.float64]) -> NDArray[np.uint8]:
    """(P,) what the map says to every point."""
    return np.asarray(OUTCOMES.take(readings(on.field.fine, on.field.resolution_m, points.probe, poses))[0])


def _largest_piece(at_m: NDArray[np.float32]) -> int:
    """Points of the largest connected piece of these (N, 2)."""
    if not len(at_m):
        return 0
    cells = ((at_m - at_m.min(axis=0)) / LINK_M).astype(np.int64)
    image = np.zeros(cells.max(axis=0) + 1, np.uint8)
    image[cells[:, 0], cells[:, 1]] = 1
    _, pieces = cv2.connectedComponents(image, connectivity=8)
    return int(np.bincount(pieces[cells[:, 0], cells[:, 1]]).max())


def turning(ours: Witness, theirs: Witness, pose: NDArray[np.float64]) -> float:
    """Metres of agreeing wall that say how the maps are turned, about whichever point says least; the worse direction.

    A round hall agrees with itself however it is turned about its middle.  Each point counts by how much of its way, were
    the map turned about that point, is along its normal.
    """
    least = math.inf
    for points, on, T in ((theirs, ours, pose[None]), (ours, theirs, inverted(pose[None]))):
        agrees = outcome_on(points, on, T) == AGREES
        n, at = (values[agrees].astype(np.float64) for values in (points.thin.normals, points.thin.positions_m))
        if not len(n):
            return 0.0
        at -= at.mean(axis=0)
        swept = at[:, 0] * n[:, 1] - at[:, 1] * n[:, 0]  # along the normals, turned about the middle
        moved = -np.linalg.solve(n.T @ n + FAR_OFF * len(n) * np.eye(2), n.T @ swept)  # and what undoes most of that
        way = moved @ moved + np.mean(np.sum(at**2, axis=1)) + 1e-9
        least = min(least, SPACING_M * float(np.sum((swept + n @ moved) ** 2) / way))
    return least
