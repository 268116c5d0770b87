"""The mapper as a whole: a robot drives through two rooms, and the map is right."""

from __future__ import annotations

import math

import numpy as np
import pytest

from agent.mapping.estimate import MapEstimate, MapperStatus
from agent.mapping.mapper import Mapper
from agent.mapping.options import MappingOptions
from protocol.geometry import SE2
from protocol.grid import OCCUPIED
from tests.agent.mapping.worlds import ROOMS, DriftingOdometry, cast, rounds, scan_at

OPTIONS = MappingOptions(particles=10)


def drive(mapper: Mapper, seconds: float, seed: int = 1) -> list[tuple[SE2, SE2]]:
    """True and estimated poses at every scan; the map frame starts at the first true pose."""
    rng = np.random.default_rng(seed)
    wheels = DriftingOdometry(rng)
    poses = []
    for stamp_s, pose in rounds(seconds):
        mapper.add_odometry(wheels.sample(stamp_s, pose))
        outcome = mapper.add_scan(scan_at(ROOMS, pose, stamp_s, rng))
        poses.append((pose, outcome.T_map_robot))
    return poses


@pytest.fixture(scope="module")
def driven() -> tuple[MapEstimate, list[tuple[SE2, SE2]]]:
    mapper = Mapper(OPTIONS, seed=0)
    poses = drive(mapper, 60.0)
    return mapper.estimate(), poses


def test_the_pose_stays_right_though_the_wheels_drift(driven: tuple[MapEstimate, list[tuple[SE2, SE2]]]) -> None:
    _, poses = driven
    T_map_world = poses[0][0].inverse()
    errors = [(T_map_world @ true).inverse() @ estimated for true, estimated in poses]
    assert max(math.hypot(e.x_m, e.y_m) for e in errors) < 0.05
    assert max(abs(e.theta_rad) for e in errors) < math.radians(0.6)


def test_walls_are_where_they_are(driven: tuple[MapEstimate, list[tuple[SE2, SE2]]]) -> None:
    estimate, poses = driven
    occupied = estimate.grid.points_of(np.argwhere(estimate.grid.cells == OCCUPIED))
    world = poses[0][0].apply(occupied)
    a, b = ROOMS[:, :2], ROOMS[:, 2:]
    along = b - a
    share = np.clip(((world[:, None] - a) * along).sum(-1) / (along**2).sum(-1), 0, 1)
    distance = np.hypot(*np.moveaxis(world[:, None] - a - share[..., None] * along, -1, 0)).min(axis=1)
    assert len(occupied) > 500
    assert np.mean(distance < 0.08) > 0.98


def test_the_same_readings_and_seed_give_the_same_map_to_the_bit() -> None:
    first, second = Mapper(OPTIONS, seed=3), Mapper(OPTIONS, seed=3)
    assert drive(first, 15.0) == drive(second, 15.0)
    assert first.estimate().grid.content_hash() == second.estimate().grid.content_hash()


def test_t_map_odom_takes_the_newest_odometry_to_the_robot() -> None:
    mapper = Mapper(OPTIONS, seed=0)
    drive(mapper, 10.0)
    estimate = mapper.estimate()
    newest = mapper.odometry.pose_at(estimate.stamp_s)
    assert newest is not None
    assert (estimate.T_map_odom @ newest).distance_m(estimate.T_map_robot) < 1e-9


def test_before_the_first_scan_nothing_is_known() -> None:
    estimate = Mapper(OPTIONS, seed=0).estimate()
    assert estimate.status is MapperStatus.STARTING
    assert not estimate.grid.known().any()


def test_changed_tiles_are_named_from_the_map_origin_and_cover_every_change() -> None:
    mapper = Mapper(OPTIONS, seed=0)
    drive(mapper, 4.0)
    before = mapper.estimate()
    drive(mapper, 0.2)
    pose = SE2(-3.0, 0.0, 0.0)
    assert np.isfinite(cast(ROOMS, pose, np.array([0.0]))).all()
    after = mapper.estimate()
    assert after.revision >= before.revision
    assert after.changed_tiles(after.revision) == []
    assert set(after.changed_tiles(0)) >= set(after.changed_tiles(before.revision))
