"""Odd, hostile and huge maps: an answer, never a crash, in bounded time; and laws that hold for any pair."""

from __future__ import annotations

import math
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agent.features.snapshot import MapSnapshot
from agent.merging.localization import localize
from agent.merging.matching import match_maps, verify_match
from agent.merging.result import MatchStatus, MergeResult
from protocol.geometry import SE2
from protocol.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from tests.agent.features.test_paper import any_cells
from tests.harness.floorplans import office

PLAN = office(seed=11)


def snapshot(cells: np.ndarray, resolution_m: float = 0.1) -> MapSnapshot:
    return MapSnapshot.of(OccupancyGrid(cells.astype(np.int8), resolution_m))


def office_map(turn_deg: float = 0.0, seed: int = 1, resolution_m: float = 0.1) -> MapSnapshot:
    return MapSnapshot.of(PLAN.mapped(SE2(2.0, -3.0, math.radians(turn_deg)), resolution_m, noise_m=0.02, seed=seed))


def odd_maps() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    stripes = np.full((1200, 1200), FREE)
    stripes[::4, :] = OCCUPIED
    stripes[:, ::60] = FREE
    return {
        "one occupied cell": np.array([[OCCUPIED]]),
        "one free cell": np.array([[FREE]]),
        "all unknown": np.full((60, 80), UNKNOWN),
        "all free": np.full((60, 80), FREE),
        "all occupied": np.full((60, 80), OCCUPIED),
        "checkerboard": np.indices((600, 600)).sum(axis=0) % 2 * OCCUPIED,
        "noise": rng.choice([UNKNOWN, FREE, OCCUPIED], (300, 300)),
        "twenty thousand lines": stripes,
        "one wall": np.pad(np.full((1, 200), OCCUPIED), 20, constant_values=FREE),
        "long and thin": np.tile([[FREE], [OCCUPIED], [FREE]], (1, 33_000)),
        "a few dots": np.pad(np.full((1, 1), OCCUPIED), 30, constant_values=FREE),
    }


@pytest.mark.parametrize("name", list(odd_maps()))
def test_odd_maps_are_answered_in_bounded_time_and_merge_with_no_other(name: str) -> None:
    odd, other = snapshot(odd_maps()[name]), office_map()
    for ours, theirs in ((other, odd), (odd, odd)):
        started = time.process_time()
        result = match_maps(ours, theirs)
        assert time.process_time() - started < 5.0
        assert ours is theirs or not result.accepted
        assert np.isfinite(result.covariance).all()


@settings(max_examples=40, deadline=None)
@given(any_cells, any_cells, st.sampled_from([0.03, 0.1, 0.2, 2.0]))
def test_no_cells_whatever_upset_matching_localizing_or_updating(ours: np.ndarray, theirs: np.ndarray, cell_m: float) -> None:
    a, b = snapshot(ours), snapshot(theirs, cell_m)
    for result in (match_maps(a, b), localize(a, b), match_maps(b.updated(a.grid), a)):
        assert np.isfinite(result.covariance).all()
        assert result.T_ours_theirs is None or result.T_ours_theirs.is_finite()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "T", [SE2(math.nan, 0, 0), SE2(0, math.inf, 0), SE2(1e300, 0, 0), SE2(0, 0, math.nan), SE2(1e6, -1e6, 1e9), SE2(0, 0, 1e300)]
)
def test_a_transform_that_is_none_is_not_confirmed(T: SE2) -> None:
    result = verify_match(office_map(), office_map(), T)
    assert result.status is MatchStatus.NO
    assert np.isfinite(result.covariance).all()


def test_the_mirror_image_of_a_building_without_symmetry_never_merges() -> None:
    cells = office_map().grid.cells.copy()
    cells[: cells.shape[0] // 2, cells.shape[1] // 2 :] = UNKNOWN  # an L
    mirrored = snapshot(cells[:, ::-1])
    assert match_maps(snapshot(cells), mirrored).status is not MatchStatus.MERGED


def test_other_buildings_never_merge() -> None:
    ours = office_map()
    for seed in range(5):
        other = MapSnapshot.of(office(seed=100 + seed).mapped(SE2(0.0, 0.0, 0.3 * seed), noise_m=0.02))
        assert not match_maps(ours, other).accepted


def test_the_same_question_has_the_same_answer_to_the_bit() -> None:
    a, b = match_maps(office_map(), office_map(50, 2)), match_maps(office_map(), office_map(50, 2))
    assert a.T_ours_theirs == b.T_ours_theirs
    assert a.evidence == b.evidence


@pytest.mark.parametrize("turn_deg", [0, 37, 90, 200])
def test_matching_the_other_way_round_gives_the_inverse(turn_deg: int) -> None:
    ours, theirs = office_map(), office_map(turn_deg, 2)
    there, back = match_maps(ours, theirs), match_maps(theirs, ours)
    assert there.accepted
    assert back.accepted
    assert_close(there, back.inverse())


def assert_close(a: MergeResult, b: MergeResult) -> None:
    assert a.T_ours_theirs is not None
    assert b.T_ours_theirs is not None
    error = np.array(
        [
            a.T_ours_theirs.x_m - b.T_ours_theirs.x_m,
            a.T_ours_theirs.y_m - b.T_ours_theirs.y_m,
            math.remainder(a.T_ours_theirs.theta_rad - b.T_ours_theirs.theta_rad, math.tau),
        ]
    )
    assert float(error @ np.linalg.solve(a.covariance + b.covariance, error)) < 11.3  # 99 % of three degrees of freedom


def test_an_inverse_covariance_is_that_of_inverted_samples() -> None:
    rng = np.random.default_rng(1)
    T, covariance = SE2(4.0, -7.0, 1.1), np.diag([0.01, 0.02, 0.0001])
    samples = rng.multivariate_normal([T.x_m, T.y_m, T.theta_rad], covariance, 40_000)
    inverses = [SE2(*sample).inverse() for sample in samples]
    seen = np.cov(np.array([(s.x_m, s.y_m, s.theta_rad) for s in inverses]).T)
    told = MergeResult(MatchStatus.MERGED, T, covariance).inverse().covariance
    assert np.allclose(told, seen, rtol=0.05, atol=2e-4)


def test_maps_of_different_resolution_merge() -> None:
    result = match_maps(office_map(0, 1, 0.05), office_map(130, 2, 0.2))
    assert result.accepted


def test_a_small_local_map_is_found_in_the_given_one() -> None:
    given = office_map()
    T_local_world = SE2(1.0, 1.0, 2.0)
    local = MapSnapshot.of(PLAN.mapped(T_local_world, x_range_m=(0.0, 12.0), noise_m=0.02, seed=5))
    result = localize(local, given)
    true = SE2(2.0, -3.0, 0.0) @ T_local_world.inverse()
    assert result.T_ours_theirs is not None
    assert result.T_ours_theirs.distance_m(true) < 0.1


def test_an_aligned_pair_is_verified_again_in_five_milliseconds() -> None:
    ours, theirs = office_map(), office_map(70, 2)
    found = match_maps(ours, theirs)
    assert found.T_ours_theirs is not None
    verify_match(ours, theirs, found.T_ours_theirs)
    spent = []
    for _ in range(9):
        started = time.process_time()
        assert verify_match(ours, theirs, found.T_ours_theirs).accepted
        spent.append(time.process_time() - started)
    assert float(np.median(spent)) < 0.010  # 2.6 ms when nothing else runs; twice the promise for a crowded machine
