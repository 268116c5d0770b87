"""Two maps in, one verdict out."""

from __future__ import annotations

import math

import numpy as np
import pytest

from agent.features.snapshot import MapSnapshot
from agent.merging.matching import match_maps, verify_match
from agent.merging.result import MatchStatus
from protocol.geometry import SE2
from protocol.grid import OccupancyGrid
from tests.harness.floorplans import office

PLAN = office(seed=5)
T_A_WORLD = SE2(3.0, -2.0, 0.3)


def mapped(T_map_world: SE2, part: tuple[float, float] = (-1.0, 1e3), resolution_m: float = 0.1, seed: int = 0) -> MapSnapshot:
    return MapSnapshot.of(PLAN.mapped(T_map_world, resolution_m, part, noise_m=0.02, seed=seed))


def error(found: SE2, true: SE2) -> tuple[float, float]:
    """Metres at the middle of the plan, degrees."""
    T_world_b = true.inverse() @ T_A_WORLD
    middle = T_world_b.apply([(PLAN.width_m / 2, PLAN.height_m / 2)])
    return float(np.hypot(*(found.apply(middle) - true.apply(middle))[0])), abs(
        math.degrees(math.remainder(found.theta_rad - true.theta_rad, math.tau))
    )


@pytest.mark.parametrize("turn_deg", range(0, 360, 24))
def test_two_maps_of_one_place_are_found_at_any_turn(turn_deg: int) -> None:
    T_b_world = SE2(-7.0, 11.0, math.radians(turn_deg))
    result = match_maps(mapped(T_A_WORLD), mapped(T_b_world, seed=1))
    assert result.status is MatchStatus.MERGED
    assert result.T_ours_theirs is not None
    metres, degrees = error(result.T_ours_theirs, T_A_WORLD @ T_b_world.inverse())
    assert metres < 0.05
    assert degrees < 0.2


def test_a_known_transform_is_confirmed_and_a_wrong_one_is_not() -> None:
    T_b_world = SE2(-7.0, 11.0, 1.0)
    ours, theirs, true = mapped(T_A_WORLD), mapped(T_b_world, seed=1), T_A_WORLD @ T_b_world.inverse()
    assert verify_match(ours, theirs, SE2(0.1, -0.1, 0.01) @ true).accepted
    assert not verify_match(ours, theirs, true @ SE2(3.0, 0.0, 0.0)).accepted


def test_nothing_known_is_no_match() -> None:
    nothing = MapSnapshot.of(OccupancyGrid.empty(0.1))
    assert match_maps(nothing, mapped(T_A_WORLD)).status is MatchStatus.NO
    assert match_maps(nothing, nothing).status is MatchStatus.NO
    assert verify_match(nothing, mapped(T_A_WORLD), SE2.identity()).status is MatchStatus.NO
