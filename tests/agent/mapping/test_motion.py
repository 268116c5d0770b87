"""Odometry: what may be believed between two moments, and motion within a revolution undone."""

from __future__ import annotations

import math

import numpy as np
import pytest

from agent.mapping.motion import EXTRAPOLATION_S, MotionNoise, OdometryTrack, undo_motion
from hw.readings import Odometry
from protocol.geometry import SE2


def track_of(*samples: tuple[float, float, float, float]) -> OdometryTrack:
    track = OdometryTrack(max_speed_m_s=3.0, max_turn_rad_s=6.0)
    for sample in samples:
        track.add(Odometry(*sample))
    return track


def test_poses_between_samples_lie_on_the_way() -> None:
    track = track_of((0.0, 0.0, 0.0, 0.0), (1.0, 1.0, 0.0, 0.4))
    pose = track.pose_at(0.25)
    assert pose is not None
    assert (pose.x_m, pose.theta_rad) == pytest.approx((0.25, 0.1))


def test_a_heading_that_wraps_turns_the_short_way() -> None:
    track = track_of((0.0, 0.0, 0.0, 3.1), (0.2, 0.0, 0.0, -3.1))
    assert track.motion_between(0.0, 0.2).T_from_to.theta_rad == pytest.approx(math.tau - 6.2)


def test_a_scan_a_little_younger_than_the_odometry_is_reached_at_constant_speed() -> None:
    track = track_of((0.0, 0.0, 0.0, 0.0), (0.1, 0.05, 0.0, 0.0))
    pose = track.pose_at(0.2)
    assert pose is not None
    assert pose.x_m == pytest.approx(0.1)
    assert track.pose_at(0.1 + 2 * EXTRAPOLATION_S) is None


def test_motion_is_the_same_whatever_the_odometry_frame() -> None:
    samples = [(0.1 * k, 0.03 * k, 0.01 * k, 0.02 * k) for k in range(20)]
    shift = SE2(5.0, -3.0, 2.0)
    placed = [(s, shift @ SE2(x, y, t)) for s, x, y, t in samples]
    moved = [(s, p.x_m, p.y_m, p.theta_rad) for s, p in placed]
    a = track_of(*samples).motion_between(0.3, 1.7).T_from_to
    b = track_of(*moved).motion_between(0.3, 1.7).T_from_to
    assert a.distance_m(b) < 1e-9
    assert a.theta_rad == pytest.approx(b.theta_rad)


def test_a_reset_is_unknown_motion_and_what_is_known_around_it_is_kept() -> None:
    track = track_of((0.0, 5.0, 0.0, 0.0), (0.1, 5.1, 0.0, 0.0), (0.2, 0.0, 0.0, 0.0), (0.3, 0.1, 0.0, 0.0))
    motion = track.motion_between(0.0, 0.3)
    assert not motion.is_known
    assert motion.T_from_to.x_m == pytest.approx(0.2)
    assert track.motion_between(0.2, 0.3).is_known


@pytest.mark.parametrize("bad", [(0.05, 0.0, 0.0, 0.0), (0.2, math.nan, 0.0, 0.0), (math.inf, 0.0, 0.0, 0.0)])
def test_older_and_senseless_samples_are_refused(bad: tuple[float, float, float, float]) -> None:
    track = track_of((0.0, 0.0, 0.0, 0.0), (0.1, 0.0, 0.0, 0.0))
    assert not track.add(Odometry(*bad))
    assert track.refused == 1


def test_a_turning_robot_sees_a_straight_wall_straight() -> None:
    turns = np.linspace(0.0, 0.6, 50)
    wall = np.stack([np.full(50, 2.0), np.linspace(-1.0, 1.0, 50)], axis=1)
    seen = np.array([SE2(0.0, 0.0, t).inverse().apply(p[None])[0] for t, p in zip(turns, wall, strict=True)])
    poses = np.stack([np.zeros(50), np.zeros(50), turns], axis=1)
    undone = undo_motion(seen, poses, SE2(0.0, 0.0, 0.3))
    assert np.allclose(SE2(0.0, 0.0, 0.3).apply(undone), wall)


def test_more_motion_is_less_certain() -> None:
    noise = MotionNoise()
    short, long = noise.deviations(SE2(0.1, 0.0, 0.05)), noise.deviations(SE2(1.0, 0.0, 0.5))
    assert long[0] > short[0] > 0
    assert long[1] > short[1] > 0


def test_a_clock_that_starts_again_begins_a_new_track() -> None:
    track = track_of((500.0, 3.0, 0.0, 0.0), (500.1, 3.1, 0.0, 0.0), (2.0, 0.0, 0.0, 0.0), (2.1, 0.1, 0.0, 0.0))
    assert track.refused == 0
    assert not track.motion_between(500.1, 2.1).is_known
    assert track.motion_between(2.0, 2.1).T_from_to.x_m == pytest.approx(0.1)


def test_after_a_long_gap_motion_is_unknown() -> None:
    track = track_of((0.0, 0.0, 0.0, 0.0), (20.0, 1.0, 0.0, 0.0))
    assert not track.motion_between(0.0, 20.0).is_known
