"""A small local map in a big one."""

from __future__ import annotations

import math

import pytest

from agent.features.snapshot import MapSnapshot
from agent.merging.localization import for_local_maps, localize
from agent.merging.result import MatchOptions, MatchStatus
from protocol.geometry import SE2
from tests.harness.floorplans import office

PLAN, OTHER = office(5), office(6)
T_GIVEN_WORLD = SE2(4.0, -3.0, 0.5)
GIVEN = MapSnapshot.of(PLAN.mapped(T_GIVEN_WORLD, noise_m=0.02, seed=1))


@pytest.mark.parametrize("left_m", [2.0, 5.0, 8.0])
def test_six_metres_of_a_building_are_found_in_it(left_m: float) -> None:
    T_local_world = SE2(-7.0, 1.0, 2.5)
    local = PLAN.mapped(T_local_world, 0.05, (left_m, left_m + 6.0), noise_m=0.02, seed=2)
    result = localize(MapSnapshot.of(local), GIVEN)
    error = (T_GIVEN_WORLD @ T_local_world.inverse()).inverse() @ result.T_ours_theirs
    assert result.accepted, result.reason
    assert math.hypot(*error.apply([(left_m, 5.0)])[0] - (left_m, 5.0)) < 0.1


def test_a_part_of_another_building_is_not() -> None:
    local = OTHER.mapped(SE2(1.0, 2.0, -1.0), 0.1, (3.0, 9.0), noise_m=0.02, seed=3)
    assert not localize(MapSnapshot.of(local), GIVEN).accepted


def test_an_empty_local_map_is_nowhere() -> None:
    nothing = PLAN.mapped(SE2.identity(), 0.1, (200.0, 206.0))
    assert localize(MapSnapshot.of(nothing), GIVEN).status is MatchStatus.NO


def test_bars_that_were_lowered_by_hand_stay_low() -> None:
    assert for_local_maps(MatchOptions(min_margin_m=1.0)).min_margin_m == 1.0
    assert for_local_maps(MatchOptions()).min_margin_m < MatchOptions().min_margin_m
