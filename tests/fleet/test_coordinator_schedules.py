"""A small slice of the campaign: seeded days in which everything breaks, and the invariants that hold all the same."""

from __future__ import annotations

import pytest

from tests.fleet.departures import run_departure
from tests.fleet.schedules import run_schedule


# 665, 7455, 710732: where a robot began anew, its old place fits by chance; 3231, 4510: judged on facts that changed since
@pytest.mark.parametrize("seed", [*range(24), 665, 3231, 4510, 7455, 710732])
def test_the_invariants_hold_whatever_breaks(seed: int) -> None:
    outcome = run_schedule(seed)
    assert outcome.wrong_edges == 0


@pytest.mark.parametrize("seed", range(4))
def test_those_who_are_left_end_with_one_map_when_a_robot_dies_for_good(seed: int) -> None:
    assert run_departure(seed).connected >= 2
