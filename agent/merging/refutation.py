"""Hypotheses that refute themselves: what looks like another place of the same kind is no rival of what raises no doubt.

Two corridors of one building, laid on each other the wrong way round, agree over twice the wall that is really common to both
maps, and twenty metres of wall stand in free space.  By the score alone that is as good as a small true overlap.  By its own
doubts it could never be merged, so it says nothing against a hypothesis that has none.  Where every hypothesis is doubtful
(mirror images, bent maps) all of them stay rivals.
"""

from __future__ import annotations

import numpy as np

from agent.features.snapshot import MapSnapshot
from agent.merging.grounds import weighed
from agent.merging.result import MatchOptions
from agent.merging.transforms import Poses
from agent.merging.validation import evidence
from agent.merging.verdict import elsewhere
from agent.merging.views import witness

_LOOKED_AT = 12  # distinct hypotheses, the best first; those behind them stay rivals


def unrefuted(ours: MapSnapshot, theirs: MapSnapshot, poses: Poses, options: MatchOptions) -> Poses:
    """The poses without those that refute themselves, where the best of the others is clear of doubt; otherwise all of them."""
    scores = evidence(witness(ours), witness(theirs), poses).score_m
    within_reach = options.max_rival_share * float(scores.max())
    left = np.ones(len(poses), np.bool_)  # to be looked at
    kept = np.ones(len(poses), np.bool_)
    is_clear = False
    for _ in range(_LOOKED_AT):
        best = int(np.argmax(np.where(left, scores, -np.inf)))
        if not left[best] or scores[best] <= 0 or not (is_clear or scores[best] > within_reach):
            break
        same = left & ~elsewhere(poses, best, theirs.middle_m)
        left &= ~same
        grounds = weighed(ours, theirs, poses[best : best + 1])[0]
        if grounds.is_refuted:
            kept &= ~same
        elif not is_clear:
            if not grounds.is_clear(options):
                break
            is_clear = True
    return poses[kept] if is_clear else poses
