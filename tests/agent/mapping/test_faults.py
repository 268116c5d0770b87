"""The hard days of a mapper: each story says what happened, and the map stays a map."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from agent.mapping.estimate import MapperStatus, ScanOutcome
from agent.mapping.mapper import CONFIRMED_AFTER, LOST_AFTER, NEW_MAP_AFTER_S, Mapper
from agent.mapping.options import MappingOptions
from hw.readings import LaserScan, Odometry
from protocol.geometry import SE2
from protocol.grid import FREE, OCCUPIED, UNKNOWN
from tests.agent.mapping.worlds import CORRIDOR, ROOMS, DriftingOdometry, rounds, scan_at

OPTIONS = MappingOptions(particles=8)
CROWD = np.array([[-1, -0.5, 0.9, -0.5], [0.9, -0.5, 0.9, 0.6], [0.9, 0.6, -0.9, 0.6], [-0.9, 0.6, -1, -0.5]])  # around the robot


@dataclass
class Drive:
    """A mapper on its way through the two rooms."""

    mapper: Mapper
    path: list[tuple[float, SE2]]
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(2))
    at: int = 0

    def __post_init__(self) -> None:
        self.wheels = DriftingOdometry(self.rng)

    @property
    def now_s(self) -> float:
        return self.path[self.at][0]

    @property
    def true(self) -> SE2:
        return self.path[0][1].inverse() @ self.path[self.at][1]

    def odometry(self) -> Odometry:
        return self.wheels.sample(*self.path[self.at])

    def scan(self) -> LaserScan:
        return scan_at(ROOMS, self.path[self.at][1], self.now_s, self.rng)

    def steps(self, n: int) -> list[ScanOutcome]:
        outcomes = []
        for _ in range(n):
            self.mapper.add_odometry(self.odometry())
            outcomes.append(self.mapper.add_scan(self.scan()))
            self.at += 1
        self.at -= 1
        self.after = outcomes[-1]
        self.at += 1
        return outcomes

    def error_m(self) -> float:
        """Of the last outcome, made one step ago."""
        true = self.path[0][1].inverse() @ self.path[self.at - 1][1]
        return self.after.T_map_robot.distance_m(true)


@pytest.fixture
def drive() -> Drive:
    return Drive(Mapper(OPTIONS, seed=0), rounds(200.0))


def test_an_encoder_reboot_is_survived(drive: Drive) -> None:
    drive.steps(100)
    drive.wheels.pose = SE2.identity()
    drive.steps(40)
    assert drive.mapper.odometry.discontinuities == 1
    assert drive.error_m() < 0.06


def test_a_marked_discontinuity_is_no_motion(drive: Drive) -> None:
    drive.steps(60)
    sample = drive.odometry()
    drive.wheels.pose = drive.wheels.pose @ SE2(0.25, 0.0, 0.1)
    drive.mapper.add_odometry(replace(sample, x_m=sample.x_m + 0.25, theta_rad=sample.theta_rad + 0.1, is_discontinuity=True))
    drive.steps(20)
    assert drive.error_m() < 0.06


def test_dropped_scans_are_bridged_by_odometry(drive: Drive) -> None:
    drive.steps(60)
    for _ in range(12):
        drive.mapper.add_odometry(drive.odometry())
        drive.at += 1
    drive.steps(30)
    assert drive.error_m() < 0.06


def test_slipping_wheels_do_not_move_the_map(drive: Drive) -> None:
    drive.steps(60)
    drive.wheels.pose = drive.wheels.pose @ SE2(-0.3, 0.1, math.radians(12))
    drive.steps(30)
    assert drive.error_m() < 0.06


@pytest.mark.parametrize("turned_deg", [9, -11])
def test_a_turn_that_the_wheels_did_not_tell_is_seen_at_once(drive: Drive, turned_deg: float) -> None:
    drive.steps(100)
    (now_s, before), turned = drive.path[100], SE2(0.0, 0.0, math.radians(turned_deg))
    drive.path[100:] = [(now_s + 0.2 * k, before @ turned) for k in range(40)]
    drive.wheels.last = before @ turned
    for outcome in drive.steps(40):
        error = outcome.T_map_robot.inverse() @ drive.path[0][1].inverse() @ before @ turned
        assert abs(math.degrees(error.theta_rad)) < 2


def test_a_jump_that_the_wheels_did_not_tell_is_believed_at_once_only_when_it_fits_very_well(drive: Drive) -> None:
    drive.steps(100)
    (now_s, before), jump = drive.path[100], SE2(-0.4, 0.0, 0.0)
    drive.path[100:] = [(now_s + 0.2 * k, before @ jump) for k in range(10)]
    drive.wheels.last = before @ jump
    statuses = []
    for _ in range(6):
        drive.mapper.add_odometry(drive.odometry())
        scan = drive.scan()
        ranges_m = np.where(drive.rng.random(180) < 0.3, 0.6 * scan.ranges_m, scan.ranges_m).astype(np.float32)
        statuses.append(drive.mapper.add_scan(replace(scan, ranges_m=ranges_m)).status)
        drive.at += 1
    assert statuses == [MapperStatus.LOST] * (LOST_AFTER - 1) + [MapperStatus.TRACKING] * 2
    drive.steps(3)
    assert drive.error_m() < 0.06


def test_without_odometry_close_scans_still_make_a_map() -> None:
    mapper = Mapper(OPTIONS, seed=0)
    rng, path = np.random.default_rng(2), rounds(30.0, hz=10.0)
    for stamp_s, pose in path:
        outcome = mapper.add_scan(scan_at(ROOMS, pose, stamp_s, rng))
    assert outcome.T_map_robot.distance_m(path[0][1].inverse() @ path[-1][1]) < 0.08


def test_without_odometry_scans_too_far_apart_are_not_drawn_and_the_reason_is_one_sentence() -> None:
    mapper = Mapper(OPTIONS, seed=0)
    rng = np.random.default_rng(2)
    outcomes = [mapper.add_scan(scan_at(ROOMS, pose, s, rng)) for s, pose in rounds(80.0)[::17]]
    held = [o for o in outcomes if o.status is MapperStatus.LOST]
    assert held
    assert all("no odometry" in o.reason and not o.is_keyframe for o in held)


def test_a_stuck_lidar_draws_nothing_and_is_named(drive: Drive) -> None:
    drive.steps(60)
    revision = drive.mapper.estimate().revision
    frozen = drive.scan()
    outcomes = []
    for _ in range(20):
        drive.mapper.add_odometry(drive.odometry())
        outcomes.append(drive.mapper.add_scan(replace(frozen, stamp_s=drive.now_s)))
        drive.at += 1
    assert outcomes[-1].status is MapperStatus.STUCK
    assert "LIDAR repeats" in outcomes[-1].reason
    assert drive.mapper.estimate().revision <= revision + 1
    drive.steps(20)
    assert drive.error_m() < 0.06


def test_a_blind_lidar_draws_nothing(drive: Drive) -> None:
    drive.steps(20)
    revision = drive.mapper.estimate().revision
    scan = drive.scan()
    outcome = drive.mapper.add_scan(replace(scan, ranges_m=np.full_like(scan.ranges_m, np.inf)))
    assert outcome.status is MapperStatus.BLIND
    assert drive.mapper.estimate().revision == revision


def test_a_place_too_wide_to_see_anything_is_no_fault_of_the_lidar(drive: Drive) -> None:
    drive.steps(20)
    statuses = []
    for _ in range(20):
        drive.mapper.add_odometry(drive.odometry())
        scan = drive.scan()
        statuses.append(drive.mapper.add_scan(replace(scan, ranges_m=np.full_like(scan.ranges_m, np.inf))).status)
        drive.at += 1
    assert set(statuses) == {MapperStatus.BLIND}


def test_a_scan_that_was_twisted_by_slipping_wheels_is_followed_and_not_drawn(drive: Drive) -> None:
    drive.steps(30)
    revision, start = drive.mapper.estimate().revision, drive.true
    for _ in range(8):
        drive.wheels.pose = drive.wheels.pose @ SE2(0.0, 0.0, 0.3)
        drive.mapper.add_odometry(drive.odometry())
        turning = replace(drive.scan(), stamp_s=drive.now_s - 0.1, duration_s=0.2)
        outcome = drive.mapper.add_scan(turning)
        assert "slip" in outcome.reason
        drive.at += 1
    moved = start.inverse() @ drive.true
    assert math.hypot(moved.x_m, moved.y_m) > 2 * OPTIONS.keyframe_distance_m
    assert drive.mapper.estimate().revision == revision
    drive.steps(5)
    assert drive.mapper.estimate().revision > revision
    assert drive.error_m() < 0.06


def test_invalid_beams_and_changing_scan_lengths_are_ordinary(drive: Drive) -> None:
    drive.steps(10)
    for k in range(60):
        drive.mapper.add_odometry(drive.odometry())
        whole = drive.scan()
        keep = np.arange(len(whole.ranges_m)) % 180 < 180 - k % 7
        ranges = whole.ranges_m.copy()
        ranges[k % 11 :: 11] = (np.nan, np.inf, 0.0)[k % 3]
        drive.mapper.add_scan(replace(whole, ranges_m=ranges[keep], angles_rad=whole.angles_rad[keep]))
        drive.at += 1
    drive.steps(10)
    assert drive.error_m() < 0.06


def test_a_partial_scan_never_clears() -> None:
    whole, part = Mapper(OPTIONS, seed=0), Mapper(OPTIONS, seed=0)
    scan = scan_at(ROOMS, SE2(-3.0, -0.2, 0.0), 0.0, np.random.default_rng(0))
    whole.add_scan(scan)
    part.add_scan(replace(scan, is_partial=True))
    assert (whole.map.drawing.grid.cells < 0).any()
    assert not (part.map.drawing.grid.cells < 0).any()
    assert np.array_equal(part.map.drawing.grid.cells > 0, whole.map.drawing.grid.cells > 0)


def test_a_kidnapped_robot_finds_itself_again_on_its_own_map(drive: Drive) -> None:
    drive.steps(260)
    outcomes = []
    drive.at += 45  # carried: the wheels saw nothing of it
    drive.wheels.last = None
    outcomes = drive.steps(60)
    assert outcomes[0].status is MapperStatus.LOST
    assert not any(o.is_keyframe for o in outcomes[:CONFIRMED_AFTER])
    assert outcomes[-1].status in (MapperStatus.TRACKING, MapperStatus.UNCONSTRAINED)
    assert drive.error_m() < 0.08
    assert drive.mapper.epoch == 0


def test_a_crowd_around_the_robot_ends_in_the_same_map_at_the_same_place(drive: Drive) -> None:
    drive.steps(150)
    x, y = drive.path[drive.at][1].x_m, drive.path[drive.at][1].y_m
    outcomes = []
    for k in range(20):  # the robot waits
        stamp_s = drive.path[drive.at][0] + 0.2 * k
        around = CROWD + np.array([x, y, x, y]) + drive.rng.normal(0.0, 0.1, CROWD.shape)
        drive.mapper.add_odometry(replace(drive.wheels.sample(stamp_s, drive.path[drive.at][1]), stamp_s=stamp_s))
        outcomes.append(drive.mapper.add_scan(scan_at(around, drive.path[drive.at][1], stamp_s, drive.rng)))
    assert outcomes[10].status is MapperStatus.LOST
    drive.path = [(s + (4.0 if k >= drive.at else 0.0), pose) for k, (s, pose) in enumerate(drive.path)]
    drive.steps(25)
    assert drive.mapper.epoch == 0
    assert drive.after.status in (MapperStatus.TRACKING, MapperStatus.UNCONSTRAINED)
    assert drive.error_m() < 0.06


@pytest.mark.parametrize("jump_m", [100.0, 0.0], ids=["the wheels jumped", "the wheels noticed nothing"])
def test_a_robot_carried_to_an_unknown_place_begins_a_new_map(drive: Drive, jump_m: float) -> None:
    drive.steps(200)
    before = drive.mapper.estimate()
    elsewhere = np.array(
        [[-1.0, -2.0, 2.5, -2.0], [2.5, -2.0, 2.5, 0.4], [2.5, 0.4, 1.6, 1.8], [1.6, 1.8, -1.0, 1.8], [-1.0, 1.8, -1.0, -2.0]]
    )
    outcomes = []
    for k in range(int((NEW_MAP_AFTER_S + 12.0) * 5)):
        stamp_s = drive.now_s + 0.2 * k
        pose = SE2(0.3 * math.sin(0.1 * k), 0.0, 0.05 * k)
        wheels = SE2(jump_m, 0.0, 0.0) @ drive.wheels.pose @ pose
        drive.mapper.add_odometry(Odometry(stamp_s, wheels.x_m, wheels.y_m, wheels.theta_rad))
        outcomes.append(drive.mapper.add_scan(scan_at(elsewhere, pose, stamp_s, drive.rng)))
    after = drive.mapper.estimate()
    assert any("new local map" in o.reason for o in outcomes)
    assert after.epoch == before.epoch + 1
    assert outcomes[-1].status is MapperStatus.TRACKING
    assert after.grid.known_area_m2() < 20.0


def test_a_robot_lost_in_a_crowd_that_drives_on_into_the_unknown_keeps_its_map(drive: Drive) -> None:
    """When the LIDAR sees again nothing of it is on the map yet; only the wheels know where it is."""
    drive.mapper = Mapper(replace(OPTIONS, matching_range_m=3.0), seed=0)
    drive.steps(20)
    (_, here), outcomes = drive.path[drive.at], []
    for k in range(90):
        is_crowd, is_blind = k < 8, 8 <= k < 60
        pose = here if is_crowd else drive.path[drive.at + k - 8][1]
        walls = CROWD + np.tile([pose.x_m, pose.y_m], 2) + drive.rng.normal(0.0, 0.1, CROWD.shape) if is_crowd else ROOMS
        stamp_s = drive.now_s + 0.2 * k
        drive.mapper.add_odometry(drive.wheels.sample(stamp_s, pose))
        outcomes.append(drive.mapper.add_scan(scan_at(walls, pose, stamp_s, drive.rng, max_m=0.1 if is_blind else 3.0)))
    assert {outcome.status for outcome in outcomes[4:8]} == {MapperStatus.LOST}
    assert outcomes[-1].status is not MapperStatus.LOST
    assert any(outcome.is_keyframe for outcome in outcomes[-10:])
    assert drive.mapper.epoch == 0
    assert outcomes[-1].T_map_robot.distance_m(drive.path[0][1].inverse() @ pose) < 0.9  # the wheels drifted by 0.7


def test_in_a_bare_corridor_the_result_says_so_and_odometry_holds_the_way() -> None:
    mapper = Mapper(replace(OPTIONS, matching_range_m=8.0), seed=0)
    rng = np.random.default_rng(2)
    for k in range(50):
        pose = SE2(0.1 * k, 0.0, 0.0)
        mapper.add_odometry(Odometry(0.2 * k, pose.x_m, 0.0, 0.0))
        outcome = mapper.add_scan(scan_at(CORRIDOR, pose, 0.2 * k, rng, beams=360, max_m=30.0))
    assert outcome.status is MapperStatus.UNCONSTRAINED
    assert outcome.T_map_robot.distance_m(SE2(4.9, 0.0, 0.0)) < 0.25


def test_a_person_who_walked_by_fades(drive: Drive) -> None:
    person = np.array([[-0.6, -0.25, -0.6, 0.05], [-0.6, 0.05, -0.4, 0.05]])
    for k in range(60):
        drive.mapper.add_odometry(drive.odometry())
        world = np.vstack([ROOMS, person]) if k < 8 else ROOMS
        drive.mapper.add_scan(scan_at(world, drive.path[drive.at][1], drive.now_s, drive.rng))
        drive.at += 1
    grid = drive.mapper.estimate().grid
    spot = (drive.path[0][1].inverse()).apply(np.array([[-0.6, -0.2], [-0.6, -0.1], [-0.6, 0.0]]))
    assert not (grid.values_at(spot) == OCCUPIED).any()


def scans_past(drive: Drive, walls: np.ndarray, is_seen: float, n: int) -> None:
    """Steps in a house where only this share of the beams that meet some walls comes back from there.

    Of the others, those through the pane come back from what stands behind it; nothing comes back from a black one.
    """
    bare = np.array([wall for wall in ROOMS if not (walls == wall).all(axis=1).any()])
    for _ in range(n):
        pose, stamp_s = drive.path[drive.at][1], drive.now_s
        whole = scan_at(ROOMS, pose, stamp_s, drive.rng)
        through = scan_at(bare, pose, stamp_s, drive.rng)
        is_lost = (through.ranges_m > whole.ranges_m + 0.1) & (drive.rng.random(len(whole.ranges_m)) >= is_seen)
        drive.mapper.add_odometry(drive.odometry())
        drive.after = drive.mapper.add_scan(replace(whole, ranges_m=np.where(is_lost, through.ranges_m, whole.ranges_m)))
        drive.at += 1


def test_black_walls_are_left_unknown_and_the_robot_keeps_its_place(drive: Drive) -> None:
    """The whole north of both rooms sends nothing back: no beam says that there is free space, either."""
    scans_past(drive, ROOMS[2:3], is_seen=0.0, n=70)
    assert drive.error_m() < 0.08
    assert drive.mapper.epoch == 0
    beyond = np.array([[x, y] for x in (-3.0, 0.0, 2.0) for y in (4.2, 4.5, 5.0)])
    cells = drive.mapper.estimate().grid.values_at(drive.path[0][1].inverse().apply(beyond))
    assert (cells == UNKNOWN).all()


def test_a_glass_wall_that_half_the_beams_pass_costs_no_more_than_itself(drive: Drive) -> None:
    """The wall between the two rooms is glass: seen, or the other room behind it, at random."""
    scans_past(drive, ROOMS[4:6], is_seen=0.5, n=70)
    assert drive.error_m() < 0.08
    assert drive.mapper.epoch == 0
    corner = drive.path[0][1].inverse().apply(np.array([[-2.0, -3.0], [0.0, 4.0]]))
    assert (drive.mapper.estimate().grid.values_at(corner) != FREE).all()
