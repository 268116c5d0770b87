"""A revolution whose motion the wheels undid wrongly is untwisted by what it shows."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from agent.mapping.mapper import Mapper
from agent.mapping.options import MappingOptions
from agent.mapping.scan_matching import information
from agent.mapping.scan_points import ScanPoints, scan_points
from agent.mapping.twist import MEAN_OF, SPUN_RAD, TwistMeans, refine_twisted
from hw.readings import LaserScan, Odometry
from tests.agent.mapping.worlds import ROOMS, DriftingOdometry, rounds, scan_at

OPTIONS = MappingOptions(particles=3)


def readings(seconds: float) -> list[tuple[Odometry, LaserScan]]:
    rng = np.random.default_rng(5)
    wheels = DriftingOdometry(rng)
    return [(wheels.sample(s, pose), scan_at(ROOMS, pose, s, rng)) for s, pose in rounds(seconds)]


def feed(mapper: Mapper, pairs: list[tuple[Odometry, LaserScan]], revolution_s: float = 0.0) -> list[object]:
    outcomes = []
    for odometry, scan in pairs:
        mapper.add_odometry(odometry)
        outcomes.append(mapper.add_scan(replace(scan, duration_s=revolution_s)).T_map_robot)
    return outcomes


@pytest.fixture(scope="module")
def seen() -> tuple[Mapper, ScanPoints]:
    """A map, and one more scan whose beams follow one another, of a robot that stands still: it is not twisted."""
    mapper, pairs = Mapper(OPTIONS, seed=0), readings(12.0)
    feed(mapper, pairs)
    odometry, scan = pairs[-1]
    for k in range(4):
        mapper.add_odometry(replace(odometry, stamp_s=odometry.stamp_s + 0.1 * (k + 1)))
    return mapper, scan_points(replace(scan, duration_s=0.2), mapper.odometry, OPTIONS)


def matched(mapper: Mapper, points: ScanPoints) -> tuple[NDArray[np.float64], float]:
    """Pose less the true one, and twist in degrees, from a start two centimetres off."""
    true, fields, particle = mapper.map.pose, mapper.map.filter.fields, mapper.map.filter.followed
    near = true + np.array([0.02, -0.01, 0.01])
    weights = information(0.03, 0.02)
    pose, twist_rad = refine_twisted(fields, particle, near, near, weights, points.surfels, points.surfel_turns)
    return pose - true, math.degrees(twist_rad)


@pytest.mark.parametrize("twist_deg", [-2.0, -1.0, 1.0, 2.0])
def test_a_twist_is_found_together_with_the_pose(seen: tuple[Mapper, ScanPoints], twist_deg: float) -> None:
    mapper, points = seen
    _, honest_deg = matched(mapper, points)  # what 180 beams with a centimetre of noise leave of no twist at all
    error, found_deg = matched(mapper, points.untwisted(-math.radians(twist_deg)))
    assert abs(honest_deg) < 0.5
    assert found_deg - honest_deg == pytest.approx(twist_deg, rel=0.4)
    assert error == pytest.approx(np.zeros(3), abs=0.015)


def test_a_scan_untwisted_and_twisted_again_is_the_scan(seen: tuple[Mapper, ScanPoints]) -> None:
    _, points = seen
    assert points.untwisted(0.0) is points
    assert np.abs(points.untwisted(0.03).points_m - points.points_m).max() > 0.02
    assert points.untwisted(0.03).untwisted(-0.03).points_m == pytest.approx(points.points_m, abs=1e-5)
    assert points.turns.min() == pytest.approx(-0.5)
    assert points.turns.max() == pytest.approx(0.5)


def test_what_a_map_adds_to_every_twist_is_taken_off_and_what_headings_show_stays() -> None:
    means, rng = TwistMeans(), np.random.default_rng(0)
    found = [(twist := rng.normal(0.004, 0.002), means.corrected(twist + 0.006, 0.004)) for _ in range(20 * MEAN_OF)]
    late = np.array(found[10 * MEAN_OF :])
    assert np.mean(late[:, 1] - late[:, 0]) == pytest.approx(0.0, abs=0.001)
    assert np.corrcoef(late.T)[0, 1] > 0.95


def test_a_wheel_that_spins_teaches_nothing() -> None:
    means = TwistMeans()
    means.corrected(0.1, 1.1 * SPUN_RAD)
    assert means == TwistMeans()


def test_a_mapper_restored_between_twisted_scans_goes_on_to_the_identical_map() -> None:
    pairs, whole, mapper = readings(6.0), Mapper(OPTIONS, seed=7), Mapper(OPTIONS, seed=7)
    expected = feed(whole, pairs, 0.1)
    begun = feed(mapper, pairs[:20], 0.1)
    assert mapper.map.twists != TwistMeans()
    mapper = Mapper.restore(mapper.checkpoint(), OPTIONS)
    assert begun + feed(mapper, pairs[20:], 0.1) == expected
    assert mapper.checkpoint() == Mapper.restore(whole.checkpoint(), OPTIONS).checkpoint()
