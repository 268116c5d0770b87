"""Transforms worth a closer look: corners that fit one another, turned to agree with the directions of the walls."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from agent.features.corners import Corners
from agent.features.signatures import Signatures
from agent.merging.blas import one_thread
from agent.merging.transforms import Poses, angle_between, no_poses, taking

MAX_CORNER_PAIRS = 1500
OPENING_TOLERANCE_RAD = math.radians(6.0)
SNAP_RAD = math.radians(4.0)
SIGNATURE_SNAP_RAD = math.radians(6.0)
TARGETS_PER_QUERY = 4
MIN_COMMON_SAMPLES = 40
MIN_LIKENESS = 0.3


def signature_candidates(
    ours: Signatures, theirs: Signatures, rotations: NDArray[np.float64], targets_per_query: int = TARGETS_PER_QUERY
) -> Poses:
    """The best-matching places of ours for every telling place of theirs, turned to agree with the walls where near."""
    if not len(ours) or not len(theirs.queries):
        return no_poses()
    with one_thread():
        alike = _likeness(theirs, ours)
    best = min(targets_per_query, alike.shape[1])
    targets = np.argpartition(-alike, best - 1, axis=1)[:, :best].ravel()
    queries = np.repeat(np.arange(len(theirs.queries)), best)
    good = alike[queries, targets] > MIN_LIKENESS
    queries, targets = queries[good], targets[good]
    rows = theirs.queries[queries]
    turn = (ours.angles_rad[targets] - theirs.angles_rad[rows]).astype(np.float64)
    turn = snapped(turn, rotations, SIGNATURE_SNAP_RAD)
    from_m, to_m = theirs.positions_m[rows].astype(np.float64), ours.positions_m[targets].astype(np.float64)
    return taking(from_m, to_m, turn)


def _likeness(theirs: Signatures, ours: Signatures) -> NDArray[np.float32]:
    """(Q, N) masked cosine of every query of theirs with every signature of ours; -1 where too little is common."""
    value, known = theirs.values[theirs.queries], theirs.known[theirs.queries]
    cross = value @ ours.values.T
    norm = ((value * value) @ ours.known.T) * (known @ (ours.values * ours.values).T)
    common = known @ ours.known.T
    likeness: NDArray[np.float32] = np.where(common >= MIN_COMMON_SAMPLES, cross / np.sqrt(np.maximum(norm, 1e-6)), -1.0)
    return likeness


def snapped(turns: NDArray[np.float64], rotations: NDArray[np.float64], within_rad: float) -> NDArray[np.float64]:
    """Every rotation replaced by the nearest of a few, where one is near enough."""
    if not len(rotations) or not len(turns):
        return turns
    away = angle_between(turns[:, None], rotations[None, :])
    nearest = away.argmin(axis=1)
    return np.where(away[np.arange(len(turns)), nearest] < within_rad, rotations[nearest], turns)


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
