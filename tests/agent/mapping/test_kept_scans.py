"""What is kept of a long day: enough to draw the map again, and no more because the day was long."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from agent.mapping import redrawing, trajectory
from agent.mapping.kept_scans import KeptScan, needless
from agent.mapping.motion import OdometryTrack
from agent.mapping.options import MappingOptions
from agent.mapping.redrawing import Drawing
from agent.mapping.scan_points import ScanPoints, scan_points
from agent.mapping.trajectory import Trajectory
from protocol.geometry import SE2
from protocol.grid import UNKNOWN
from tests.agent.mapping.worlds import ROOMS, rounds, scan_at

OPTIONS = MappingOptions()


def points_at(pose: SE2, rng: np.random.Generator) -> ScanPoints:
    return scan_points(scan_at(ROOMS, pose, 0.0, rng), OdometryTrack(3.0, 6.0), OPTIONS)


def laps(n: int, keyframes: int = 60) -> np.ndarray:
    """(N, 3) round and round in a circle of three metres, no lap exactly like another."""
    rng = np.random.default_rng(1)
    along = np.arange(n * keyframes) * (math.tau / keyframes)
    return np.stack([3 * np.cos(along), 3 * np.sin(along), along + math.pi / 2], axis=1) + rng.normal(0.0, 0.01, (len(along), 3))


def left(poses: np.ndarray) -> list[int]:
    return np.flatnonzero(~needless(poses, np.zeros(len(poses), bool))).tolist()


def test_a_kept_scan_is_the_scan_to_a_millimetre() -> None:
    points = points_at(SE2(-3.0, -0.2, 0.0), np.random.default_rng(0))
    kept = KeptScan.of(points)
    assert np.abs(kept.points_m - points.points_m).max() < 0.0005
    assert np.array_equal(kept.is_hit, points.is_hit)
    assert kept.nbytes < 0.55 * (points.points_m.nbytes + points.is_hit.nbytes)


def test_what_is_kept_grows_with_the_ground_and_not_with_time() -> None:
    few, many = len(left(laps(10))), len(left(laps(40)))
    assert 100 < few <= many < 1.25 * few
    standing = np.repeat(laps(1)[:1], 1000, axis=0)
    assert left(standing) == [0, 998, 999]


def test_of_a_place_the_first_scan_and_the_last_two_stay() -> None:
    here, there = np.array([[0.2, 0.2, 0.0]]), np.array([[0.2, 0.2, math.pi]])
    visits = np.repeat([here, there, here, there], [4, 3, 2, 5], axis=0)[:, 0]
    assert left(visits) == [0, 4, 7, 8, 12, 13]


def test_the_map_drawn_again_from_what_is_kept_is_the_same_map(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(redrawing, "NEVER_THINNED", 20)
    monkeypatch.setattr(redrawing, "FEWEST_TO_THIN", 60)
    rng, drawing = np.random.default_rng(0), Drawing(OPTIONS)
    drawing.thin_at = 60
    path = np.array([[p.x_m, p.y_m, p.theta_rad] for _, p in rounds(200.0, hz=1.5)])
    for k, pose in enumerate(path):
        drawing.add(points_at(SE2(*pose), rng), pose)
        drawing.follow(path[: k + 1])
    before = drawing.grid.trinary().cells
    assert len(drawing.scans) < 0.8 * len(path)
    drawing.resume(path, 0, is_bent=False)
    while drawing.fresh is not None:
        drawing.follow(path)
    after = drawing.grid.trinary().cells
    known = (before != UNKNOWN) | (after != UNKNOWN)
    assert np.mean(before[known] == after[known]) > 0.98


def test_too_many_bytes_are_drawn_for_good(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(redrawing, "KEPT_BYTES", 20 * 800)
    monkeypatch.setattr(redrawing, "FEWEST_TO_THIN", 20)
    rng, drawing = np.random.default_rng(0), Drawing(OPTIONS)
    drawing.thin_at = 20
    path = np.array([[p.x_m, p.y_m, p.theta_rad] for _, p in rounds(40.0, hz=1.5)])
    for k, pose in enumerate(path):
        drawing.add(points_at(SE2(*pose), rng), pose)
        drawing.follow(path[: k + 1])
    assert drawing.oldest > 0
    assert len(drawing.scans) < 30
    before = drawing.grid.trinary()
    drawing.resume(path[drawing.oldest :], 0, is_bent=False)
    while drawing.fresh is not None:
        drawing.follow(path)
    assert np.array_equal(drawing.grid.trinary().cells, before.cells)


def test_a_long_trajectory_stays_whole_and_grows_coarser_with_age(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trajectory, "KEPT_SCANS", 100)
    kept = Trajectory()
    for k in range(1000):
        kept.add(0.1 * k, 0, SE2(float(k), 0.0, 0.0))
    stamps_s, x_m = kept.placed(np.zeros((1, 3)))[:, :2].T
    assert len(kept) <= 100
    assert (stamps_s[0], stamps_s[-1]) == pytest.approx((0.0, 99.9))
    assert np.allclose(x_m, 10 * stamps_s)
    gaps_s = np.diff(stamps_s)
    assert gaps_s[-40:].max() < 0.11 < gaps_s[:5].min()


def test_a_lidar_that_looks_all_round_needs_no_second_heading() -> None:
    all_round = scan_at(ROOMS, SE2(0.0, 0.0, 0.0), 0.0, np.random.default_rng(0))
    half = replace(all_round, angles_rad=all_round.angles_rad / 2)
    seen = [scan_points(scan, OdometryTrack(3.0, 6.0), OPTIONS).is_all_round for scan in (all_round, half)]
    assert seen == [True, False]
    turning = np.stack([np.zeros(400), np.zeros(400), np.arange(400) * (math.tau / 50)], axis=1)
    assert [np.count_nonzero(~needless(turning, np.full(400, is_round))) for is_round in (True, False)] == [3, 24]
