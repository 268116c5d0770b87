"""Scan matching finds the offset it was given, and says what it cannot know."""

from __future__ import annotations

import math

import numpy as np
import pytest

from agent.mapping.correlation import CoarseField
from agent.mapping.likelihood import TiledFields, put_max
from agent.mapping.motion import OdometryTrack
from agent.mapping.options import MappingOptions
from agent.mapping.relocalization import Relocalization
from agent.mapping.scan_matching import information, placed, refine, weakest_direction
from agent.mapping.scan_points import ScanPoints, scan_points
from protocol.geometry import SE2
from tests.agent.mapping.worlds import CORRIDOR, ROOMS, scan_at

WEAK = information(1.0, 1.0)


def points_at(world: np.ndarray, pose: SE2, seed: int = 0, range_m: float = 10.0) -> ScanPoints:
    scan = scan_at(world, pose, 0.0, np.random.default_rng(seed), beams=360)
    return scan_points(scan, OdometryTrack(3.0, 6.0), MappingOptions(matching_range_m=range_m))


def field_of(points: ScanPoints, copies: int = 1) -> TiledFields:
    fields = TiledFields(copies, 0.05, 0.06)
    fields.cover(np.array([-15.0, -15.0]), np.array([15.0, 15.0]))
    x, y, _, _ = placed(np.zeros((copies, 3)), points.surface_m)
    fields.stamp(x, y)
    return fields


@pytest.mark.parametrize("offset", [(0.08, 0.0, 0.0), (0.0, -0.08, 0.02), (-0.06, 0.05, -0.03), (0.02, 0.02, 0.04)])
def test_a_known_offset_is_recovered(offset: tuple[float, float, float]) -> None:
    here = SE2(-1.0, -0.5, 0.3)
    fields = field_of(points_at(ROOMS, here))
    moved = points_at(ROOMS, here @ SE2(*offset), seed=1)
    fit = refine(fields, np.zeros(1, int), np.zeros((1, 3)), np.zeros((1, 3)), WEAK[None], moved.surfels, 6)
    assert fit.poses[0][:2] == pytest.approx(offset[:2], abs=0.012)
    assert fit.poses[0][2] == pytest.approx(offset[2], abs=math.radians(0.25))


def test_all_particles_at_once_are_each_one_alone() -> None:
    points = points_at(ROOMS, SE2(-1.0, -0.5, 0.3))
    fields = field_of(points, copies=3)
    poses = np.array([[0.05, 0.0, 0.0], [0.0, 0.03, 0.01], [-0.04, 0.0, -0.02]])
    weights = np.broadcast_to(WEAK, (3, 3, 3))
    together = refine(fields, np.arange(3), poses, poses, weights, points.surfels)
    for k in range(3):
        alone = refine(fields, np.array([k]), poses[k : k + 1], poses[k : k + 1], WEAK[None], points.surfels)
        assert np.array_equal(alone.poses[0], together.poses[k])


def test_a_corridor_leaves_its_own_direction_open_and_the_prior_decides_there() -> None:
    fields = field_of(points_at(CORRIDOR, SE2(0.0, 0.0, 0.0), range_m=6.0))
    moved = points_at(CORRIDOR, SE2(0.1, 0.0, 0.0), seed=1, range_m=6.0)
    prior = np.array([[0.1, 0.0, 0.0]])
    fit = refine(fields, np.zeros(1, int), prior, prior, information(0.05, 0.02)[None], moved.surfels)
    ratio, direction = weakest_direction(fit.curvature[0])
    assert ratio < 0.03
    assert abs(direction[0]) > 0.95
    assert fit.poses[0][0] == pytest.approx(0.1, abs=0.03)


def test_a_room_holds_every_direction() -> None:
    points = points_at(ROOMS, SE2(-1.0, -0.5, 0.3))
    fit = refine(field_of(points), np.zeros(1, int), np.zeros((1, 3)), np.zeros((1, 3)), WEAK[None], points.surfels)
    assert weakest_direction(fit.curvature[0])[0] > 0.05


def test_the_coarse_search_comes_within_reach_of_a_far_offset() -> None:
    here, offset = SE2(-1.0, -0.5, 0.3), SE2(0.6, -0.5, 0.4)
    coarse = CoarseField()
    coarse.stamp(points_at(ROOMS, here).matching_m)
    poses, scores = coarse.best_poses(np.zeros(3), points_at(ROOMS, here @ offset, seed=1).matching_m, 0.8, math.radians(30), 4)
    assert min(math.hypot(p[0] - offset.x_m, p[1] - offset.y_m) for p in poses) < 0.2
    assert scores[0] == scores.max()


def test_a_place_on_the_whole_map_is_found_from_one_scan() -> None:
    here, offset = SE2(-1.0, -0.5, 0.3), SE2(-1.2, 1.1, 2.5)
    points = points_at(ROOMS, here)
    fields, coarse = field_of(points), CoarseField()
    coarse.stamp(points.matching_m)
    search = Relocalization(coarse, points_at(ROOMS, here @ offset, seed=1).surfels, 0.0)
    while not search.is_done:
        search.step()
    answer = search.answer(fields, 0)
    assert answer is not None
    assert math.hypot(answer[0] - offset.x_m, answer[1] - offset.y_m) < 0.05
    assert abs(answer[2] - offset.theta_rad) < 0.02


def test_a_place_that_is_not_on_the_map_is_not_found() -> None:
    points = points_at(ROOMS, SE2(-1.0, -0.5, 0.3))
    fields, coarse = field_of(points), CoarseField()
    coarse.stamp(points.matching_m)
    other = ROOMS @ np.kron(np.eye(2), np.array([[0.5, 0.2], [-0.1, 0.4]]))
    search = Relocalization(coarse, points_at(other, SE2(0.3, 0.1, 1.0), seed=1).surfels, 0.0)
    while not search.is_done:
        search.step()
    assert search.answer(fields, 0) is None


def test_putting_maxima_is_the_obvious_loop() -> None:
    rng = np.random.default_rng(0)
    places, values = rng.integers(0, 40, 500), rng.integers(0, 256, 500).astype(np.uint8)
    fast, slow = np.full(40, 7, np.uint8), np.full(40, 7, np.uint8)
    put_max(fast, places, values)
    for place, value in zip(places, values, strict=True):
        slow[place] = max(slow[place], value)
    assert np.array_equal(fast, slow)
