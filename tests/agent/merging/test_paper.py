"""The paper's Algorithm 1, literal and guarded."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings

from agent.features.paper import PaperFeatures
from agent.features.snapshot import MapSnapshot
from agent.merging.paper import match_by_the_paper, match_guarded, rotation_candidates, similar_features, translation_candidates
from agent.merging.result import MatchOptions, MatchStatus, MergeResult, Reason
from protocol.geometry import SE2, wrap_angle
from protocol.grid import OCCUPIED, OccupancyGrid
from tests.agent.features.test_paper import any_cells
from tests.harness.floorplans import FloorPlan, office

OPTIONS = MatchOptions(method="paper")
T_A, T_B = SE2(3.0, -2.0, 0.3), SE2(-10.0, 5.0, 2.5)


def halves(plan: FloorPlan, overlap: float = 0.5, resolution_m: float = 0.1) -> tuple[OccupancyGrid, OccupancyGrid, SE2]:
    """The left and the right of a building, each in its own frame, and the truth."""
    left, right = plan.width_m * (0.5 + overlap / 2), plan.width_m * (0.5 - overlap / 2)
    ours, theirs = plan.mapped(T_A, resolution_m, (-1, left)), plan.mapped(T_B, resolution_m, (right, 1e3))
    return ours, theirs, T_A @ T_B.inverse()


def error_m(T: SE2, truth: SE2, theirs: OccupancyGrid) -> float:
    middle = theirs.points_of([(theirs.height / 2, theirs.width / 2)])
    return float(np.hypot(*(T.apply(middle) - truth.apply(middle))[0]))


def literal(ours: OccupancyGrid, theirs: OccupancyGrid) -> MergeResult:
    return match_by_the_paper(ours, theirs, OPTIONS)


def guarded(ours: OccupancyGrid, theirs: OccupancyGrid) -> MergeResult:
    return match_guarded(MapSnapshot.of(ours), MapSnapshot.of(theirs), OPTIONS)


def rows(*features: tuple[float, float, float, float]) -> np.ndarray:
    return np.array(features, np.float64)


def test_pairs_are_of_one_kind_and_within_fifteen_percent():
    ours = PaperFeatures(lines=rows((0, 0, 1.0, 0), (0, 0, 2.0, 0)), curves=rows((0, 0, 1.0, 0)))
    theirs = PaperFeatures(lines=rows((0, 0, 1.17, 0), (0, 0, 1.2, 0)), circles=rows((0, 0, 1.0, 0)))
    pairs = similar_features(ours, theirs, 0.15)
    assert len(pairs) == 1
    assert (pairs.ours[0, 2], pairs.theirs[0, 2]) == (1.0, 1.17)


def test_the_most_frequent_turn_is_tried_first_and_so_is_its_opposite():
    angles = [0.5, 0.5, 0.5, 1.2]
    ours = PaperFeatures(lines=np.array([(0, 0, 10.0**i, a) for i, a in enumerate(angles)]))
    theirs = PaperFeatures(lines=np.array([(0, 0, 10.0**i, 0.1) for i in range(4)]))
    turns = list(rotation_candidates(similar_features(ours, theirs, 0.15), 1.0))
    assert turns[0] == pytest.approx(0.4, abs=math.radians(0.51))
    assert turns[1] == pytest.approx(turns[0] + math.pi)


def test_the_most_frequent_shift_is_tried_first():
    centres = np.array([(0, 0), (3, 1), (7, 2), (4, 9)], np.float64)
    moved = centres + np.array([10.0, -4.0])
    moved[3] += 3.0
    sizes = np.array([[1, 0.0], [10, 0.0], [100, 0.0], [1000, 0.0]])
    pairs = similar_features(
        PaperFeatures(lines=np.hstack([moved, sizes])), PaperFeatures(lines=np.hstack([centres, sizes])), 0.15
    )
    assert next(translation_candidates(pairs, 0.0)) == SE2(10.0, -4.0, 0.0)


@pytest.mark.parametrize("seed", [0, 1, 3])
def test_two_halves_of_an_office_come_together(seed):
    ours, theirs, truth = halves(office(seed))
    result = literal(ours, theirs)
    assert result.accepted
    assert result.factor.value > 0.9
    assert error_m(result.T_ours_theirs, truth, theirs) < 0.3
    assert abs(wrap_angle(result.T_ours_theirs.theta_rad - truth.theta_rad)) < math.radians(2)


def test_taken_alone_the_match_factor_merges_different_buildings_and_the_guards_do_not():
    ours, _, _ = halves(office(0))
    _, theirs, _ = halves(office(9))
    assert literal(ours, theirs).accepted
    result = guarded(ours, theirs)
    assert not result.accepted
    assert result.T_ours_theirs is not None


@pytest.mark.parametrize("seed", range(6))
def test_guards_let_the_right_merge_pass(seed):
    ours, theirs, truth = halves(office(seed), overlap=0.4)
    result = guarded(ours, theirs)
    assert result.accepted
    assert error_m(result.T_ours_theirs, truth, theirs) < ours.resolution_m
    assert result.score > result.runner_up_score + OPTIONS.min_margin_m


def test_a_bare_corridor_is_never_merged_by_the_guarded_paper():
    walls = np.array([(0, 0, 40, 0), (0, 2, 40, 2)], np.float64)
    corridor = FloorPlan(walls, np.zeros((0, 3)), 40.0, 2.0)
    ours, theirs, _ = halves(corridor)
    result = guarded(ours, theirs)
    assert result.status is not MatchStatus.MERGED
    assert result.reason != Reason.MATCHED


@settings(max_examples=30, deadline=None)
@given(any_cells, any_cells)
@pytest.mark.parametrize("match", [literal, guarded])
def test_no_maps_whatever_upset_it(match, ours, theirs):
    result = match(OccupancyGrid(ours, 0.1), OccupancyGrid(theirs, 0.1))
    assert result.T_ours_theirs is None or result.T_ours_theirs.is_finite()


def test_maps_full_of_walls_are_bounded_work():
    noise = np.where(np.random.default_rng(0).random((400, 400)) < 0.3, OCCUPIED, 0).astype(np.int8)
    grid = OccupancyGrid(noise, 0.1)
    assert literal(grid, grid).candidates_tried <= 2400
