"""Two maps in, one verdict out: candidates, refinement, evidence, and the comparison with the best alternative."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from agent.features.snapshot import MapSnapshot
from agent.merging.paper import match_maps_like_the_paper
from agent.merging.refinement import FINE_GATES_M, normal_equations, refined
from agent.merging.result import Alternative, MatchFactor, MatchOptions, MatchStatus, MergeResult, Reason
from agent.merging.search import FIRST_PASS, search, side, witness
from agent.merging.transforms import Poses, angle_between, applied, to_se2
from agent.merging.validation import Evidence, evidence, match_factor
from protocol.geometry import SE2

SAME_PLACE_M = 0.8  # two transforms that move the middle of the overlap less than this, and
SAME_TURN_RAD = 0.105  # turn it less than 6 degrees, are one hypothesis
MAX_RIVAL_SHARE = 0.6
MIN_AGREEING_SHARE = 0.55
MIN_OBSERVABILITY_M = 2.0
_COVARIANCE_SCALE = 0.05**2 * 16.0  # measured: normalised errors have mean one


def match_maps(ours: MapSnapshot, theirs: MapSnapshot, options: MatchOptions | None = None) -> MergeResult:
    """Find the transform that lays their map on ours."""
    options = options or MatchOptions()
    if options.method.startswith("paper"):
        return match_maps_like_the_paper(ours, theirs, options)
    poses, tried = search(ours, theirs, FIRST_PASS)
    if not len(poses):
        return MergeResult.none(Reason.NO_CANDIDATES)
    return _judged(ours, theirs, poses, tried, options)


def verify_match(ours: MapSnapshot, theirs: MapSnapshot, T_ours_theirs: SE2, options: MatchOptions | None = None) -> MergeResult:
    """Judge one known transform again on the present maps: refine, then decide, without looking for rivals."""
    options = options or MatchOptions()
    if not len(ours.thin_walls) or not len(theirs.thin_walls):
        return MergeResult.none(Reason.EMPTY)
    T = ours.grid.origin.inverse() @ T_ours_theirs @ theirs.grid.origin
    poses = refined(side(ours, 500), side(theirs, 500), np.array([[T.x_m, T.y_m, T.theta_rad]]), FINE_GATES_M)
    return _judged(ours, theirs, poses, 1, options)


def _judged(ours: MapSnapshot, theirs: MapSnapshot, poses: Poses, tried: int, options: MatchOptions) -> MergeResult:
    found = evidence(witness(ours), witness(theirs), poses)
    scores = found.score()
    best = int(scores.argmax())
    rival = _rival_score(poses, scores, best, theirs.middle_m)
    factor, overlap_m2 = match_factor(ours.working, theirs.working, poses[best])
    status, reason = _verdict(found, best, float(scores[best]), rival, factor, options)
    order = [int(i) for i in np.argsort(-scores, kind="stable") if i != best][:8]
    return MergeResult(
        status,
        _map_frame(ours, theirs, poses[best]),
        _covariance(ours, theirs, poses[best : best + 1]),
        factor,
        overlap_m2,
        float(scores[best]),
        rival,
        tried,
        reason,
        tuple(Alternative(_map_frame(ours, theirs, poses[i]), float(scores[i])) for i in order),
        {
            "agreeing_m": float(found.agreeing_m[best]),
            "conflicting_m": float(found.conflicting_m[best]),
            "crossing_m": float(found.crossing_m[best]),
            "observability_m": float(found.observability_m[best]),
        },
    )


def _verdict(
    found: Evidence, best: int, score: float, rival: float, factor: MatchFactor, options: MatchOptions
) -> tuple[MatchStatus, str]:
    agreeing, against = found.agreeing_m[best], found.conflicting_m[best] + found.crossing_m[best]
    if agreeing <= options.min_margin_m or score <= options.min_margin_m:
        return MatchStatus.NO, Reason.LITTLE_WALL
    if agreeing / (agreeing + against) <= MIN_AGREEING_SHARE:
        return MatchStatus.NO, Reason.CONFLICTS
    if factor.value < options.min_match_factor:
        return MatchStatus.NO, Reason.LOW_MATCH_FACTOR
    if found.observability_m[best] <= MIN_OBSERVABILITY_M:
        return MatchStatus.AMBIGUOUS, Reason.UNOBSERVABLE
    if score - rival <= options.min_margin_m or rival >= MAX_RIVAL_SHARE * score:
        return MatchStatus.AMBIGUOUS, Reason.RIVAL
    return MatchStatus.MERGED, Reason.MATCHED


def _rival_score(poses: Poses, scores: NDArray[np.float64], best: int, around_m: NDArray[np.float64]) -> float:
    """Score of the best transform that means something else; zero when there is none."""
    place = applied(poses, around_m)
    apart = np.hypot(*(place - place[best]).T) > SAME_PLACE_M
    apart |= angle_between(poses[:, 2], poses[best, 2]) > SAME_TURN_RAD
    return max(0.0, float(scores[apart].max())) if apart.any() else 0.0


def _covariance(ours: MapSnapshot, theirs: MapSnapshot, pose: Poses) -> NDArray[np.float64]:
    """(3, 3) covariance of x, y, theta of T_ours_theirs, map frames, from the curvature at the solution."""
    normal = normal_equations(side(ours, 500), side(theirs, 500), pose, 0.15)
    about_centre = np.linalg.inv(normal.H[0] + 1e-3 * np.eye(3)) * _COVARIANCE_SCALE
    T = _map_frame(ours, theirs, pose[0])
    centre = ours.grid.origin.apply(normal.centre)[0]
    R = np.eye(3)
    R[:2, :2] = ours.grid.origin.rotation()
    to_origin = np.eye(3)
    to_origin[0, 2], to_origin[1, 2] = -(T.y_m - centre[1]), T.x_m - centre[0]
    J = to_origin @ R
    return np.asarray(J @ about_centre @ J.T)


def _map_frame(ours: MapSnapshot, theirs: MapSnapshot, pose: NDArray[np.float64]) -> SE2:
    """A grid-frame transform as T_ours_theirs of the map frames."""
    return ours.grid.origin @ to_se2(pose) @ theirs.grid.origin.inverse()
