"""The numbers a verdict rests on, gathered for the best of several transforms."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from agent.features.snapshot import MapSnapshot
from agent.merging.doubts import doubts, turning
from agent.merging.result import MatchFactor
from agent.merging.sharpness import sharpness
from agent.merging.transforms import Poses
from agent.merging.validation import evidence, match_factor
from agent.merging.verdict import Grounds, rival_score
from agent.merging.views import witness


def weighed(
    ours: MapSnapshot, theirs: MapSnapshot, poses: Poses
) -> tuple[Grounds, MatchFactor, float, NDArray[np.float64], NDArray[np.int64]]:
    """Grounds of the best transform, its match factor and common area, then every score and the order from best to worst."""
    found = evidence(witness(ours), witness(theirs), poses)
    order = np.argsort(-found.score_m, kind="stable")
    best = int(order[0])
    factor, overlap_m2 = match_factor(ours.working, theirs.working, poses[best])
    grounds = Grounds(
        float(found.score_m[best]),
        rival_score(poses, found.score_m, best, theirs.middle_m),
        float(found.agreeing_m[best]),
        float(found.against_m[best]),
        float(found.potential_m[best]),
        float(found.observability_m[best]),
        factor.value,
        max(ours.working.resolution_m, theirs.working.resolution_m),
        *doubts(witness(ours), witness(theirs), poses[best]),
        turning(witness(ours), witness(theirs), poses[best]),
        *sharpness(witness(ours), witness(theirs), poses[best]),
    )
    return grounds, factor, overlap_m2, found.score_m, order
