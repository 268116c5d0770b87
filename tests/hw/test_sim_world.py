"""Worlds, rays and the robots that drive through them."""

from __future__ import annotations

import math
import time
from pathlib import Path

import numpy as np
import pytest

from hw.errors import DeviceConfigError
from hw.sim.obedient import ObedientRobot
from hw.sim.places import Clearance
from hw.sim.raycast import cast, cast_all
from hw.sim.robot import DriveOptions, SimulatedRobot
from hw.sim.sight import Sight, Turntable
from hw.sim.world import MAX_FILE_BYTES, ROBOT_RADIUS_M, World, open_world
from protocol.geometry import SE2
from protocol.grid import FREE, OCCUPIED

WORLDS = ["office", "office?seed=5", "outdoor", "outdoor?seed=2", "random", "random?seed=3"]


@pytest.mark.parametrize("spec", WORLDS)
def test_rays_equal_the_slow_and_obvious_version(spec: str) -> None:
    world = open_world(spec)
    rng = np.random.default_rng(7)
    x0, y0, x1, y1 = world.bounds
    for moved_m in (0.0, 0.05, 3.0):
        origins = rng.uniform((x0, y0), (x1, y1)) + rng.uniform(-moved_m, moved_m, (200, 2))
        bearings = rng.uniform(-10, 10, 200)
        assert np.array_equal(cast(world.segments, origins, bearings, 12.0)[0], cast_all(world.segments, origins, bearings, 12.0))


def test_a_ray_meets_a_wall_at_the_angle_it_does() -> None:
    wall = np.array([[2.0, -5.0, 2.0, 5.0]])
    bearings = np.array([0.0, math.pi / 3, math.pi])
    ranges_m, cosines = cast(wall, np.zeros((3, 2)), bearings, 10.0)
    assert ranges_m == pytest.approx([2.0, 4.0, np.inf])
    assert cosines == pytest.approx([1.0, 0.5, 1.0])


def test_a_scan_of_the_office_costs_a_few_milliseconds_at_most() -> None:
    world = open_world("office")
    start = world.start_poses(1)[0]
    origins = np.tile([start.x_m, start.y_m], (450, 1))
    bearings = np.linspace(0, math.tau, 450)
    begun_s = time.process_time()
    for _ in range(20):
        cast(world.segments, origins, bearings, 12.0)
    assert (time.process_time() - begun_s) / 20 < 0.005


@pytest.mark.parametrize("spec", WORLDS)
def test_every_place_of_a_built_in_world_can_be_reached(spec: str) -> None:
    clearance = Clearance.of(open_world(spec))
    if not spec.startswith("outdoor"):
        assert clearance.is_one_place(ROBOT_RADIUS_M)
    assert clearance.main_place(ROBOT_RADIUS_M + 0.1).sum() * clearance.resolution_m**2 > 60


@pytest.mark.parametrize("spec", WORLDS)
def test_the_truth_is_free_where_robots_start_and_occupied_on_the_walls(spec: str) -> None:
    world = open_world(spec)
    truth = world.truth()
    starts = world.start_poses(3, seed=1)
    assert all(truth.values_at([(start.x_m, start.y_m)])[0] == FREE for start in starts)
    middles = (world.segments[:, :2] + world.segments[:, 2:]) / 2
    around = [truth.values_at(middles + np.array([dx, dy])) == OCCUPIED for dx in (-0.02, 0.02) for dy in (-0.02, 0.02)]
    assert np.all(np.any(around, axis=0))


def test_one_seed_is_one_world_and_another_seed_another() -> None:
    assert np.array_equal(open_world("office?seed=4").segments, open_world("office?seed=4").segments)
    assert not np.array_equal(open_world("office?seed=4").segments, open_world("office?seed=5").segments)


def test_starts_are_some_way_apart() -> None:
    starts = open_world("office").start_poses(3)
    assert all(2.0 < a.distance_m(b) < 20.0 for i, a in enumerate(starts) for b in starts[:i])


def test_a_world_file_says_walls_circles_and_starts() -> None:
    world = World.parse("0 0 4 0 # south\n4 0 4 4\n4 4 0 4\n0 4 0 0\ncircle 3 3 0.25\nstart 1 2 90\n", "room.txt")
    assert world.start_poses(1) == [SE2(1, 2, math.pi / 2)]
    ranges_m = Sight(ObedientRobot(world, SE2(1, 2, 0)), noise_m=0).ranges_m(np.zeros(2), np.array([0.0, math.pi]), 0, 10)
    assert ranges_m == pytest.approx([3.0, 1.0])


@pytest.mark.parametrize(("text", "says"), [("0 0 1", "room:1"), ("0 0 1 x", "room:1"), ("0 0 1 1e9", "room:1"), ("", "0 walls"),
    ("0 0 1 1\ncircle 1 1", "room:2"), ("circle 1 1 -1", "room:1"), ("nan 0 1 1", "room:1")])  # fmt: skip
def test_a_bad_world_file_is_refused_with_its_line(text: str, says: str) -> None:
    with pytest.raises(DeviceConfigError, match=says):
        World.parse(text, "room")


def test_an_unknown_world_says_what_there_is() -> None:
    with pytest.raises(DeviceConfigError, match="office, outdoor, random"):
        open_world("ofice")
    for spec in ("office?seed=x", "office?sed=3", "office?seed=-1", "office?seed=²"):
        with pytest.raises(DeviceConfigError, match=r"office\?seed=3"):
            open_world(spec)


@pytest.mark.parametrize("name", ["what?.txt", "r#1.txt", "a b.txt", "r%20.txt", "http:x", "räum.txt", "room.txt?seed=3"])
def test_a_world_file_may_have_any_name(name: str, tmp_path: Path) -> None:
    (tmp_path / name.removesuffix("?seed=3")).write_bytes(b"\xef\xbb\xbf0 0 4 0\r\n4 0 4 4\r\n")  # as Windows' editor writes it
    assert len(open_world(str(tmp_path / name)).segments) == 2


def test_a_world_file_that_cannot_be_read_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "room.txt").write_bytes(b"#" * (MAX_FILE_BYTES + 1))
    with pytest.raises(DeviceConfigError, match="list of walls"):
        open_world(str(tmp_path / "room.txt"))

    def denied(*_: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", denied)
    with pytest.raises(DeviceConfigError, match="Permission denied"):
        open_world(str(tmp_path / "room.txt"))


def test_walls_that_leave_no_place_to_start_are_said() -> None:
    with pytest.raises(DeviceConfigError, match="--pose"):
        World.parse("0 0 4 0", "wall.txt").start_poses(1)


def driven(world: World, seconds: float, seed: int = 0) -> np.ndarray:
    robot = SimulatedRobot(world, world.start_poses(1, seed)[0], seed)
    robot.poses_at(np.array([100.0]))
    robot.begin()
    return robot.poses_at(100.0 + np.arange(0, seconds, 0.05))


@pytest.mark.parametrize("spec", ["office", "random?seed=3", "outdoor"])
def test_an_exploring_robot_gets_about_and_never_hits_a_wall(spec: str) -> None:
    world = open_world(spec)
    poses = driven(world, 40.0)
    clearance = Clearance.of(world)
    assert min(clearance.at(x, y) for x, y in poses[:, :2]) > ROBOT_RADIUS_M - 0.1
    way_m = np.hypot(*np.diff(poses[:, :2], axis=0).T).sum()
    assert way_m > 0.25 * 40.0
    assert len({(round(x / 2), round(y / 2)) for x, y in poses[:, :2]}) >= 4


def test_a_drive_is_the_same_however_often_it_is_asked_for() -> None:
    world = open_world("random?seed=3")
    often, once = (SimulatedRobot(world, world.start_poses(1)[0], 5) for _ in range(2))
    for robot in (often, once):
        robot.poses_at(np.array([50.0]))
        robot.begin()
    for k in range(400):
        often.poses_at(np.array([50.0 + 0.05 * k]))
    assert often.pose_at(70.0) == once.pose_at(70.0)
    assert often.ticks_at(70.0) == once.ticks_at(70.0)


def test_encoders_without_error_integrate_to_the_true_pose() -> None:
    from hw.odometry import TickIntegrator, TickSample, WheelGeometry  # noqa: PLC0415

    world, options = open_world("random?seed=3"), DriveOptions(scale_error=0.0, slip=0.0, ticks_per_revolution=100_000)
    robot = SimulatedRobot(world, world.start_poses(1)[0], 5, options)
    robot.poses_at(np.array([50.0]))
    robot.begin()
    geometry = WheelGeometry.of_wheel(options.ticks_per_revolution, options.wheel_radius_m, options.track_m)
    integrator = TickIntegrator(geometry)
    for k in range(1001):
        odometry = integrator.add(TickSample(*robot.ticks_at(50.0 + 0.02 * k), 64), 50.0 + 0.02 * k)
    true = robot.start.inverse() @ robot.pose_at(70.0)
    assert (odometry.x_m, odometry.y_m) == pytest.approx((true.x_m, true.y_m), abs=0.02)


def test_a_turntable_hands_out_every_beam_once_at_its_time() -> None:
    head = Turntable.in_frames(10.0, 100, 12)
    head.restart(5.0)
    parts = [part for k in range(1, 60) for part in head.due(5.0 + 0.0071 * k)]
    index = np.concatenate([part.turn * 100 + part.index for part in parts])
    assert np.array_equal(index, np.arange(len(index)))
    times_s = np.concatenate([part.times_s for part in parts])
    assert times_s == pytest.approx(5.0 + (index + 1) / 1000.0)
