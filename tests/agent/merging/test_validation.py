"""What a map says about a wall of another map: agreement, contradiction, or nothing."""

from __future__ import annotations

import numpy as np
import pytest

from agent.features.snapshot import MapSnapshot
from agent.merging.scoring import weight_against
from agent.merging.validation import evidence
from agent.merging.views import witness
from protocol.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

SAME_FRAME = np.zeros((1, 3))


def corridor(south: int, beyond: int) -> MapSnapshot:
    """A corridor of 12 by 2 m; what its south wall was found to be, and what lies behind it."""
    cells = np.full((60, 140), UNKNOWN, np.int8)
    cells[5:20, 10:130] = beyond
    cells[20:40, 10:130] = FREE
    cells[19, 10:130] = south
    cells[40, 10:130] = cells[20:40, 9] = OCCUPIED
    return MapSnapshot.of(OccupancyGrid(cells, 0.1))


SEEN = corridor(south=OCCUPIED, beyond=UNKNOWN)


def against(other: MapSnapshot) -> float:
    return float(evidence(witness(other), witness(SEEN), SAME_FRAME).against_m[0])


def test_a_wall_where_free_space_ends_in_the_unknown_is_no_contradiction() -> None:
    assert against(corridor(south=UNKNOWN, beyond=UNKNOWN)) < 1.0


def test_a_wall_that_beams_passed_through_is_one() -> None:
    assert against(corridor(south=FREE, beyond=FREE)) > 4.0


@pytest.mark.parametrize(("wall_share", "weight"), [(0.9, 1.0), (0.45, 1.0), (0.12, 0.69), (0.06, 0.58)])
def test_conflicts_weigh_less_where_space_is_wide(wall_share: float, weight: float) -> None:
    assert weight_against(wall_share) == pytest.approx(weight, abs=0.02)
