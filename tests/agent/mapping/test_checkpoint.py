"""A mapper that was saved and restored goes on as if nothing had happened, to the bit."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from agent.mapping import particle_filter
from agent.mapping.mapper import Mapper
from agent.mapping.options import MappingOptions
from agent.mapping.state_block import CheckpointError
from hw.readings import LaserScan, Odometry
from tests.agent.mapping.worlds import ROOMS, DriftingOdometry, rounds, scan_at

OPTIONS = MappingOptions(particles=8)


def readings(seconds: float) -> list[tuple[Odometry, LaserScan]]:
    rng = np.random.default_rng(5)
    wheels = DriftingOdometry(rng)
    return [(wheels.sample(s, pose), scan_at(ROOMS, pose, s, rng)) for s, pose in rounds(seconds)]


def feed(mapper: Mapper, pairs: list[tuple[Odometry, LaserScan]]) -> list[object]:
    outcomes = []
    for odometry, scan in pairs:
        mapper.add_odometry(odometry)
        outcome = mapper.add_scan(scan)
        outcomes.append((outcome.status, outcome.T_map_robot, outcome.is_keyframe, outcome.fraction))
    return outcomes


def test_a_resumed_mapper_draws_the_identical_map(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(particle_filter, "RESAMPLE_BELOW", 0.99)  # the number of particles changes within seconds
    monkeypatch.setattr(particle_filter, "USUAL_SPREAD_M", 0.005)
    pairs = readings(24.0)
    whole = Mapper(OPTIONS, seed=7)
    expected = feed(whole, pairs)
    mapper, outcomes = Mapper(OPTIONS, seed=7), []
    for start, end in pairwise([0, 1, 13, 50, 80, len(pairs)]):
        outcomes += feed(mapper, pairs[start:end])
        mapper = Mapper.restore(mapper.checkpoint(), OPTIONS)
    assert outcomes == expected
    assert len({len(poses) for poses in mapper.map.filter.path}) > 2
    assert mapper.estimate().grid.content_hash() == whole.estimate().grid.content_hash()
    assert np.array_equal(mapper.map.trajectory(), whole.map.trajectory())
    assert mapper.checkpoint() == Mapper.restore(whole.checkpoint(), OPTIONS).checkpoint()


def test_a_mapper_saved_before_its_first_scan_is_a_new_mapper() -> None:
    mapper = Mapper.restore(Mapper(OPTIONS, seed=7).checkpoint(), OPTIONS)
    pairs = readings(2.0)
    assert feed(mapper, pairs) == feed(Mapper(OPTIONS, seed=7), pairs)


def test_every_damaged_byte_is_noticed() -> None:
    mapper = Mapper(OPTIONS, seed=7)
    feed(mapper, readings(2.0))
    data = mapper.checkpoint()
    for at in np.random.default_rng(0).integers(0, len(data), 60):
        with pytest.raises(CheckpointError):
            Mapper.restore(data[:at] + bytes([data[at] ^ 0x40]) + data[at + 1 :], OPTIONS)
    for length in (0, 3, 40, len(data) - 1):
        with pytest.raises(CheckpointError):
            Mapper.restore(data[:length], OPTIONS)


def test_a_map_of_another_resolution_is_refused_with_both_numbers() -> None:
    data = Mapper(OPTIONS, seed=7).checkpoint()
    with pytest.raises(CheckpointError, match=r"0\.05 m.*0\.1 m"):
        Mapper.restore(data, MappingOptions(particles=8, resolution_m=0.1))


def test_after_a_reboot_the_robot_finds_itself_on_its_old_map() -> None:
    """Another clock, wheels at zero, and carried three metres while it was off."""
    pairs = readings(70.0)
    mapper = Mapper(OPTIONS, seed=7)
    feed(mapper, pairs[:250])
    mapper = Mapper.restore(mapper.checkpoint(), OPTIONS)
    true = [pose for _, pose in rounds(70.0)]
    rest = [(replace(o, stamp_s=o.stamp_s - 49.0), replace(s, stamp_s=s.stamp_s - 49.0)) for o, s in pairs[280:]]
    feed(mapper, rest)
    assert mapper.epoch == 0
    end = true[0].inverse() @ true[-1]
    assert mapper.map.pose[:2] == pytest.approx((end.x_m, end.y_m), abs=0.08)
