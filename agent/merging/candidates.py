"""Transforms worth a closer look: corners that fit one another, turned to agree with the directions of the walls."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from agent.features.corners import Corners
from agent.merging.transforms import Poses, angle_between, no_poses, taking

MAX_CORNER_PAIRS = 1500
OPENING_TOLERANCE_RAD = math.radians(6.0)
SNAP_RAD = math.radians(4.0)


def corner_candidates(ours: Corners, theirs: Corners, rotations: NDArray[np.float64]) -> Poses:
    """Pairs of corners with the same opening, their rotation snapped to the nearest common wall rotation."""
    if not len(ours) or not len(theirs) or not len(rotations):
        return no_poses()
    same = np.abs(ours.openings_rad[:, None] - theirs.openings_rad[None, :]) < OPENING_TOLERANCE_RAD
    same &= ours.convex[:, None] == theirs.convex[None, :]
    i, j = np.nonzero(same)
    turn = ours.directions_rad[i] - theirs.directions_rad[j]
    away = angle_between(turn[:, None], rotations[None, :])
    nearest = away.argmin(axis=1)
    keep = np.flatnonzero(away[np.arange(len(turn)), nearest] < SNAP_RAD)
    if len(keep) > MAX_CORNER_PAIRS:
        quality = np.minimum(ours.quality[i[keep]], theirs.quality[j[keep]])
        keep = keep[np.argsort(-quality, kind="stable")[:MAX_CORNER_PAIRS]]
    return taking(theirs.positions_m[j[keep]], ours.positions_m[i[keep]], rotations[nearest[keep]])
