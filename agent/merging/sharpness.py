"""How sharply wall that agrees lies on the other map's wall: on the same things, or on things like them.

Rooms of one size are furnished alike, and no two the same.  Laid on each other, their long walls fall together to two or three
centimetres and their desks to ten: within the tolerance of agreement, and far beyond what the maps err, as the long walls tell.
Where a map is bent its long walls err too, so what is small is held against what is long, never against a fixed bound alone.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agent.features.structure import LONG
from agent.features.wall_points import SPACING_M
from agent.merging.doubts import outcome_on
from agent.merging.scoring import AGREES, looked_up, placed
from agent.merging.transforms import inverted
from agent.merging.validation import Witness

USUAL_M, USUAL_POINTS = 0.05, round(2.0 / SPACING_M)  # believed of both before any wall is seen: two metres of it


class Sharpness(NamedTuple):
    """Root mean square distance of agreeing wall from the line of the wall that it lies on, metres, both directions."""

    long_error_m: float
    small_error_m: float  # of all that is no long wall


def sharpness(ours: Witness, theirs: Witness, pose: NDArray[np.float64]) -> Sharpness:
    """Of one transform."""
    forth, back = _errors_m(theirs, ours, pose[None]), _errors_m(ours, theirs, inverted(pose[None]))
    return Sharpness(*(_spread_m(np.concatenate(both)) for both in zip(forth, back, strict=True)))


def _errors_m(points: Witness, on: Witness, poses: NDArray[np.float64]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """How far points that agree lie from the line of the nearest wall point of the other map: of long walls, of all else."""
    agrees = np.flatnonzero(outcome_on(points, on, poses) == AGREES)
    columns, rows = placed(points.probe.xy1[:, agrees], poses, on.field.resolution_m)
    nearest = looked_up(on.field.nearest, columns, rows, outside=-1)[0].astype(np.int64)
    at_m = (np.stack([columns[0], rows[0]], axis=1) + 0.5) * on.field.resolution_m
    errors_m = np.sum((at_m - on.walls.positions_m[nearest]) * on.walls.normals[nearest], axis=1)
    is_long = points.kinds[agrees] == LONG
    return errors_m[is_long], errors_m[~is_long]


def _spread_m(errors_m: NDArray[np.float32]) -> float:
    squares = float(errors_m @ errors_m) + USUAL_POINTS * USUAL_M**2
    return float(np.sqrt(squares / (len(errors_m) + USUAL_POINTS)))
