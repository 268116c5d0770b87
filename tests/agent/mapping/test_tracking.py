"""The front end doubts a match that is not sure, and jumps only onto one that is."""

from __future__ import annotations

import numpy as np

from agent.mapping.correlation import CoarseField
from agent.mapping.tracking import GOOD_FRACTION, SURE_FRACTION, Tracked, track
from protocol.geometry import SE2
from tests.agent.mapping.test_scan_matching import field_of, points_at

PERIOD_M = 0.3
STANDING, SURE_OF_IT = (0.0, 0.0), (0.02, 0.01)  # a step, and one sigma of it


def niches() -> np.ndarray:
    """(S, 4) a room with niches in two walls, which look the same one niche farther; nothing else in it does."""
    along = np.arange(-3.0, 3.0, PERIOD_M)
    walls = [[[x, y, x, y + side], [x, y, x + PERIOD_M, y]] for x in along for y, side in ((-1.2, -0.12), (1.2, 0.12))]
    return np.array([*np.concatenate(walls), [-3.0, -1.2, -3.0, 1.2], [3.0, -1.2, 3.0, 1.2], [1.0, -0.3, 1.4, 0.3]])


def tracked_from(predicted: tuple[float, float, float]) -> Tracked:
    """The robot stands where it stood, and is predicted elsewhere by wheels that are sure."""
    here = points_at(niches(), SE2(0.0, 0.0, 0.1))
    coarse = CoarseField()
    coarse.stamp(here.surface_m)
    again = points_at(niches(), SE2(0.0, 0.0, 0.1), seed=1)
    return track(field_of(here), 0, coarse, np.array(predicted), STANDING, SURE_OF_IT, again.surfels)


def test_a_fair_match_beside_a_better_one_is_left_for_it() -> None:
    for predicted in ((PERIOD_M, 0.0, 0.0), (-PERIOD_M, 0.0, 0.0)):
        found = tracked_from(predicted)
        assert np.abs(found.pose).max() < 0.03
        assert found.fraction > SURE_FRACTION > GOOD_FRACTION


def test_what_wheels_rule_out_is_called_a_jump() -> None:
    assert not tracked_from((0.01, 0.0, 0.0)).is_jump
    assert tracked_from((PERIOD_M, 0.0, 0.0)).is_jump
