"""The funnel from thousands of candidate transforms to a handful of refined ones, each step dearer and for fewer.

corners and signatures (then correlation) -> coarse score -> distinct -> both ways -> roughly refined -> distinct -> refined
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent.features.snapshot import MapSnapshot
from agent.merging.candidates import TARGETS_PER_QUERY, corner_candidates, signature_candidates
from agent.merging.correlation import correlation_candidates
from agent.merging.refinement import refined
from agent.merging.rotations import rotation_candidates
from agent.merging.scoring import scores
from agent.merging.transforms import Poses, distinct, inverted, no_poses
from agent.merging.views import places, probe, search_worth, side


@dataclass(frozen=True, slots=True)
class Effort:
    """How many candidates each step of the funnel lets through."""

    rotations: int = 8  # peaks of the wall directions' correlation
    correlated: int = 0  # of these, how many are searched by Fourier transform, with four neighbours each
    peaks: int = 20  # translations each of those yields
    scored: int = 300  # of every source, after the coarse score
    drawn: int = 60  # roughly refined
    kept: int = 20  # refined to the end
    targets: int = TARGETS_PER_QUERY  # places of ours that every telling place of theirs is laid on
    snapped: bool = True  # signatures' rotations are those of the walls; in bent maps these err by 3 degrees
    everywhere: bool = False  # places of ours are all of its walls, not the most telling


FIRST_PASS = Effort()  # corners and signatures: 20 ms for two cached indoor maps
SECOND_PASS = Effort(correlated=4, drawn=200, kept=40, snapped=False)  # finds what the first missed in 1 pair of 50, and rivals

NEIGHBOUR_RAD = math.radians(1.2)  # peaks err by about this; correlation over a large map does not forgive it
_ROUGH_GATES_M = (0.8, 0.6, 0.4)
_LAST_GATES_M = (0.4, 0.3, 0.2, 0.15)
_FEW, _SOME, _MANY = 120, 250, 500  # points


def search(ours: MapSnapshot, theirs: MapSnapshot, effort: Effort) -> tuple[Poses, int]:
    """The best distinct transforms, refined (grid frames), and how many were tried."""
    if not len(ours.thin_walls) or not len(theirs.thin_walls):
        return no_poses(), 0
    found = list(_sources(ours, theirs, effort))
    tried = sum(len(poses) for poses in found)
    poses = np.concatenate([_coarsely_best(ours, theirs, poses, effort.scored) for poses in found])
    if not len(poses):
        return poses, tried
    poses = poses[np.argsort(-_both_ways(ours, theirs, poses, "coarse"), kind="stable")[: effort.drawn]]
    poses = refined(side(ours, _FEW), side(theirs, _FEW), poses, _ROUGH_GATES_M)
    poses = poses[distinct(poses, _both_ways(ours, theirs, poses, "fine"), theirs.middle_m, effort.kept)]
    return refined(side(ours, _MANY), side(theirs, _MANY), poses, _LAST_GATES_M), tried


def _sources(ours: MapSnapshot, theirs: MapSnapshot, effort: Effort) -> Iterator[Poses]:
    rotations = rotation_candidates(ours.directions, theirs.directions, effort.rotations)
    yield corner_candidates(ours.corners, theirs.corners, rotations)
    places_of_ours = ours.dense_signatures if effort.everywhere else ours.signatures
    snaps = rotations if effort.snapped else rotations[:0]
    yield signature_candidates(places_of_ours, theirs.signatures, snaps, effort.targets)
    if effort.correlated and len(rotations):
        first = rotations[: effort.correlated]
        turns = np.concatenate([rotations, *(first + k * NEIGHBOUR_RAD for k in (-2, -1, 1, 2))])
        yield correlation_candidates(places(ours), places(theirs), turns, effort.peaks)


def _coarsely_best(ours: MapSnapshot, theirs: MapSnapshot, poses: Poses, limit: int) -> Poses:
    """By a few points of the map with less wall, on the other."""
    if len(ours.thin_walls) < len(theirs.thin_walls):
        score = _one_way(theirs, ours, inverted(poses), "coarse", 160)
    else:
        score = _one_way(ours, theirs, poses, "coarse", 160)
    return poses[distinct(poses, score, theirs.middle_m, limit)]


def _both_ways(ours: MapSnapshot, theirs: MapSnapshot, poses: Poses, field: str) -> NDArray[np.float32]:
    there = _one_way(ours, theirs, poses, field, _SOME)
    back = _one_way(theirs, ours, inverted(poses), field, _SOME)
    mean: NDArray[np.float32] = 0.5 * (there + back)
    return mean


def _one_way(on: MapSnapshot, points: MapSnapshot, poses: Poses, field: str, count: int) -> NDArray[np.float32]:
    image = on.field.fine if field == "fine" else on.field.coarse
    return scores(image, on.field.resolution_m, probe(points, count), poses, search_worth(on))
