"""A plan and its mirror image: what looks alike and must not merge."""

from __future__ import annotations

import numpy as np
import pytest

from agent.features.snapshot import MapSnapshot
from agent.merging.grounds import weighed
from agent.merging.matching import match_maps
from agent.merging.mirror import is_mirror_image, mirrored
from agent.merging.result import MatchOptions, Reason
from agent.merging.search import FIRST_PASS, search
from protocol.geometry import SE2
from protocol.grid import OccupancyGrid
from tests.harness.floorplans import office

TEMPTING = (631206797, 585936016, 321424425, 25991004, 20024775)  # plans whose mirror images fit over 50 m of wall


def plan_map(
    seed: int, yaw_rad: float = 0.4, noise_seed: int = 1, part: tuple[float, float] = (-1.0, 1e3), hit: bool = False
) -> MapSnapshot:
    return MapSnapshot.of(office(seed).mapped(SE2(1.0, 2.0, yaw_rad), x_range_m=part, noise_m=0.02, seed=noise_seed, hit=hit))


def is_suspected(ours: MapSnapshot, theirs: MapSnapshot) -> bool:
    return is_mirror_image(ours, theirs, weighed(ours, theirs, search(ours, theirs, FIRST_PASS)[0])[0])


@pytest.mark.parametrize("hit", [False, True])
@pytest.mark.parametrize("seed", TEMPTING)
def test_a_mirrored_plan_never_merges(seed: int, hit: bool) -> None:
    ours, theirs = plan_map(seed, hit=hit), mirrored(plan_map(seed, -1.3, noise_seed=2, hit=hit))
    assert not match_maps(ours, theirs).accepted
    assert not match_maps(theirs, ours).accepted


def test_it_is_the_reflection_that_says_no() -> None:
    ours = plan_map(631206797)
    assert match_maps(ours, mirrored(ours), MatchOptions(mirror_test=False)).accepted
    assert match_maps(ours, mirrored(ours)).reason == Reason.LOOK_ALIKE


@pytest.mark.parametrize("seed", range(4))
def test_true_halves_are_not_suspected(seed: int) -> None:
    ours, theirs = plan_map(seed, part=(-1.0, 18.0)), plan_map(seed, 2.0, noise_seed=2, part=(9.0, 1e3))
    assert not is_suspected(ours, theirs)
    assert match_maps(ours, theirs).accepted


def test_a_plan_that_is_its_own_mirror_image_is_not_suspected() -> None:
    """Both fits are as good: the reflection is no less suspicious, so it says nothing."""
    cells = plan_map(3).grid.cells
    both = np.concatenate([cells, cells[:, ::-1]], axis=1)
    ours = MapSnapshot.of(OccupancyGrid(both, 0.1))
    assert not is_suspected(ours, ours)


def test_turned_over_twice_is_the_map() -> None:
    ours = plan_map(0)
    assert np.array_equal(mirrored(mirrored(ours)).grid.cells, ours.grid.cells)
