"""Two maps in, one verdict out: candidates, refinement, evidence, and the comparison with the best alternative."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from agent.features.snapshot import MapSnapshot
from agent.merging.grounds import weighed
from agent.merging.mirror import is_mirror_image
from agent.merging.paper import match_maps_like_the_paper
from agent.merging.refinement import FINE_GATES_M, normal_equations, refined
from agent.merging.refutation import unrefuted
from agent.merging.result import Alternative, MatchOptions, MatchStatus, MergeResult, Reason
from agent.merging.search import FIRST_PASS, SECOND_PASS, search
from agent.merging.transforms import Poses, to_se2
from agent.merging.verdict import verdict
from agent.merging.views import side
from protocol.geometry import SE2

_ALTERNATIVES = 8
_POINTS = 500
_NOWHERE_M = 1e7  # no two maps are this far apart; single precision could not tell where


def match_maps(ours: MapSnapshot, theirs: MapSnapshot, options: MatchOptions | None = None) -> MergeResult:
    """Find the transform that lays their map on ours."""
    options = options or MatchOptions()
    if options.method.startswith("paper"):
        return match_maps_like_the_paper(ours, theirs, options)
    if not len(ours.thin_walls) or not len(theirs.thin_walls):
        return MergeResult.none(Reason.EMPTY)
    poses, tried = search(ours, theirs, FIRST_PASS)
    result = judged(ours, theirs, poses, tried, options)
    if result.accepted or not options.thorough:
        return result
    more, also_tried = search(ours, theirs, SECOND_PASS)
    poses, tried = np.concatenate([poses, more]), tried + also_tried
    result = judged(ours, theirs, poses, tried, options)
    return result if result.accepted else _without_refuted(ours, theirs, poses, result, options)


def verify_match(ours: MapSnapshot, theirs: MapSnapshot, T_ours_theirs: SE2, options: MatchOptions | None = None) -> MergeResult:
    """Judge one known transform again on the present maps: refine, then decide, without looking for rivals or reflections."""
    options = options or MatchOptions()
    if not len(ours.thin_walls) or not len(theirs.thin_walls):
        return MergeResult.none(Reason.EMPTY)
    T = ours.grid.origin.inverse() @ T_ours_theirs @ theirs.grid.origin
    if not (T.is_finite() and math.hypot(T.x_m, T.y_m) < _NOWHERE_M):
        return MergeResult.none(Reason.NO_CANDIDATES)
    pose = np.array([[T.x_m, T.y_m, T.theta_rad]])
    return judged(
        ours,
        theirs,
        refined(side(ours, _POINTS), side(theirs, _POINTS), pose, FINE_GATES_M),
        1,
        replace(options, mirror_test=False),
    )


def judged(ours: MapSnapshot, theirs: MapSnapshot, poses: Poses, tried: int, options: MatchOptions) -> MergeResult:
    """The verdict on the best of the refined transforms."""
    if not len(poses):
        return MergeResult.none(Reason.NO_CANDIDATES)
    grounds, factor, overlap_m2, scores, order = weighed(ours, theirs, poses)
    best = int(order[0])
    status, reason = verdict(grounds, options)
    if status is MatchStatus.MERGED and options.mirror_test and is_mirror_image(ours, theirs, grounds):
        status, reason = MatchStatus.AMBIGUOUS, Reason.LOOK_ALIKE
    return MergeResult(
        status,
        _map_frame(ours, theirs, poses[best]),
        _covariance(ours, theirs, poses[best]),
        factor,
        overlap_m2,
        grounds.score,
        grounds.rival,
        tried,
        reason,
        tuple(Alternative(_map_frame(ours, theirs, poses[i]), float(scores[i])) for i in order[1 : 1 + _ALTERNATIVES]),
        grounds.numbers(),
    )


def _without_refuted(
    ours: MapSnapshot, theirs: MapSnapshot, poses: Poses, result: MergeResult, options: MatchOptions
) -> MergeResult:
    """This undecided result, or the merge that it becomes when hypotheses that refute themselves are left out."""
    left = unrefuted(ours, theirs, poses, options) if len(poses) and result.score > options.min_margin_m else poses
    if len(left) == len(poses):
        return result
    again = judged(ours, theirs, left, result.candidates_tried, options)
    return again if again.accepted else result


def _covariance(ours: MapSnapshot, theirs: MapSnapshot, pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 3) covariance of x, y, theta of T_ours_theirs, map frames, from curvature and residuals at the solution."""
    normal = normal_equations(side(ours, _POINTS), side(theirs, _POINTS), pose[None], FINE_GATES_M[-1])
    about_centre = normal.covariances()[0]
    T, origin = _map_frame(ours, theirs, pose), ours.grid.origin
    centre = origin.apply(normal.centre)[0]
    J = np.eye(3)
    J[:2, :2] = origin.rotation()
    J[:2, 2] = -(T.y_m - centre[1]), T.x_m - centre[0]
    return np.asarray(J @ about_centre @ J.T)


def _map_frame(ours: MapSnapshot, theirs: MapSnapshot, pose: NDArray[np.float64]) -> SE2:
    """A grid-frame transform as T_ours_theirs of the map frames."""
    return ours.grid.origin @ to_se2(pose) @ theirs.grid.origin.inverse()
