"""The funnel from thousands of candidate transforms to a handful of refined ones, each step dearer and for fewer.

rotations from wall directions -> corners and correlation -> coarse score -> distinct -> refined -> distinct -> refined to the end
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent.features.snapshot import MapSnapshot
from agent.merging.candidates import corner_candidates
from agent.merging.correlation import Places, correlation_candidates
from agent.merging.refinement import Side, refined
from agent.merging.rotations import rotation_candidates
from agent.merging.scoring import SEARCH_WORTH, Probe, scores
from agent.merging.transforms import Poses, distinct, inverted, no_poses
from agent.merging.validation import Witness


@dataclass(frozen=True, slots=True)
class Effort:
    """How many candidates each step of the funnel lets through."""

    rotations: int = 6
    peaks: int = 20  # translations a rotation
    scored: int = 300
    drawn: int = 60  # roughly refined
    kept: int = 20  # refined to the end


FIRST_PASS = Effort()
SECOND_PASS = Effort(rotations=12, peaks=30, scored=600, drawn=150, kept=40)

_ROUGH_GATES_M = (0.8, 0.6, 0.4)
_LAST_GATES_M = (0.4, 0.3, 0.2, 0.15)


def search(ours: MapSnapshot, theirs: MapSnapshot, effort: Effort = FIRST_PASS) -> tuple[Poses, int]:
    """The best distinct transforms, refined, and how many were tried."""
    rotations = rotation_candidates(ours.directions, theirs.directions, effort.rotations)
    if not len(rotations) or not len(ours.thin_walls) or not len(theirs.thin_walls):
        return no_poses(), 0
    corners = corner_candidates(ours.corners, theirs.corners, rotations)
    shifts, _ = correlation_candidates(places(ours), places(theirs), rotations, effort.peaks)
    poses = np.concatenate([corners, shifts])
    tried = len(poses)
    poses = poses[distinct(poses, _coarse_scores(ours, theirs, poses), theirs.middle_m, effort.scored)]
    poses = poses[np.argsort(-_scores(ours, theirs, poses, "coarse"), kind="stable")[: effort.drawn]]
    poses = refined(side(ours, 120), side(theirs, 120), poses, _ROUGH_GATES_M)
    poses = poses[distinct(poses, _scores(ours, theirs, poses, "fine"), theirs.middle_m, effort.kept)]
    return refined(side(ours, 500), side(theirs, 500), poses, _LAST_GATES_M), tried


def _coarse_scores(ours: MapSnapshot, theirs: MapSnapshot, poses: Poses) -> NDArray[np.float32]:
    """A few points of the map with less wall, on the other."""
    if len(ours.thin_walls) < len(theirs.thin_walls):
        return _one_way(theirs, ours, inverted(poses), "coarse", 160)
    return _one_way(ours, theirs, poses, "coarse", 160)


def _scores(ours: MapSnapshot, theirs: MapSnapshot, poses: Poses, field: str) -> NDArray[np.float32]:
    """Both directions."""
    there = _one_way(ours, theirs, poses, field, 250)
    back = _one_way(theirs, ours, inverted(poses), field, 250)
    mean: NDArray[np.float32] = 0.5 * (there + back)
    return mean


def _one_way(on: MapSnapshot, points: MapSnapshot, poses: Poses, field: str, count: int) -> NDArray[np.float32]:
    image = on.field.fine if field == "fine" else on.field.coarse
    return scores(image, on.field.resolution_m, probe(points, count), poses, SEARCH_WORTH)


def probe(snapshot: MapSnapshot, count: int) -> Probe:
    return snapshot.kept(("probe", count), lambda s: Probe.sample(s.thin_walls, count))


def side(snapshot: MapSnapshot, count: int) -> Side:
    return snapshot.kept(("side", count), lambda s: Side.of(s.thin_walls, s.walls, s.field, count))


def places(snapshot: MapSnapshot) -> Places:
    return snapshot.kept("places", lambda s: Places.of(s.working, s.thin_walls))


def witness(snapshot: MapSnapshot) -> Witness:
    return snapshot.kept("witness", lambda s: Witness(s.thin_walls, Probe.of(s.thin_walls), s.field))
