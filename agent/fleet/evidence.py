"""A result of matching as evidence: in the words, the order and the numbers on which both sides can agree."""

from __future__ import annotations

from typing import Any

import numpy as np

from agent.fleet.pair import Running
from agent.merging.result import MergeResult, inverse_covariance
from protocol.geometry import SE2, wrap_angle
from protocol.messages import Evidence, Symmetric3

MAX_ALTERNATIVES = 4  # in a record; a person looks at no more


def evidence_of(us: str, running: Running, result: MergeResult) -> Evidence | None:
    """A result as both sides will speak of it; None when its numbers cannot be trusted."""
    T = result.T_ours_theirs
    if T is None or not T.is_finite() or not np.all(np.isfinite(result.covariance)):
        return None
    them = running.job.peer
    covariance = result.covariance
    a, b, map_a, map_b = us, them, running.ours, running.theirs
    if them < us:
        a, b, map_a, map_b = them, us, running.theirs, running.ours
        covariance, T = inverse_covariance(T, covariance), T.inverse()
    T = SE2(float(T.x_m) + 0.0, float(T.y_m) + 0.0, wrap_angle(float(T.theta_rad)) + 0.0)
    factor = result.factor
    overlap_m2, score = float(max(result.overlap_m2, 0.0)), float(np.clip(result.score, -1e9, 1e9))
    figures = (int(factor.agree), int(factor.disagree), overlap_m2, score)
    return Evidence(a, b, map_a, map_b, us, T, _upper(covariance), *figures)


def facts_of(running: Running, result: MergeResult) -> dict[str, Any]:
    """The numbers of one attempt, for the records."""
    T = result.T_ours_theirs
    return {
        "peer": running.job.peer,
        "purpose": running.purpose.value,
        "status": result.status.value,
        "reason": result.reason,
        "match_factor": result.factor.value,
        "overlap_m2": result.overlap_m2,
        "score": result.score,
        "runner_up": result.runner_up_score,
        "candidates": result.candidates_tried,
        "ours": running.ours.digest.hex()[:8],
        "theirs": running.theirs.digest.hex()[:8],
        "T_ours_theirs": None if T is None else plain(T),
        "alternatives": [(*plain(a.T_ours_theirs), round(a.score, 2)) for a in result.alternatives[:MAX_ALTERNATIVES]],
    }


def plain(T: SE2) -> tuple[float, float, float]:
    """x, y, yaw to a millimetre and a hundredth of a degree."""
    return round(float(T.x_m), 3), round(float(T.y_m), 3), round(float(T.theta_rad), 4)


def _upper(covariance: object) -> Symmetric3:
    """The upper triangle, made symmetric and safely positive."""
    full = np.asarray(covariance, np.float64)
    full = 0.5 * (full + full.T)
    values, vectors = np.linalg.eigh(full)
    full = (vectors * np.clip(values, 1e-12, 1e9)) @ vectors.T
    xx, xy, xt, yy, yt, tt = (float(full[i, j]) for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)))
    return xx, xy, xt, yy, yt, tt
