"""The filter: tiles are shared until they differ, resampling is fair, lineages hold together."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from agent.mapping import particle_filter
from agent.mapping.likelihood import AREA, TiledFields
from agent.mapping.mapper import Mapper
from agent.mapping.options import MappingOptions
from agent.mapping.particle_filter import ParticleFilter, heir, systematic, wanted_particles
from tests.agent.mapping.test_mapper import drive

F32 = np.float32


def stamped(fields: TiledFields, x: list[float], y: list[float]) -> TiledFields:
    fields.cover(np.array([-4.0, -4.0]), np.array([4.0, 4.0]))
    fields.stamp(np.array([x] * fields.particles, F32), np.array([y] * fields.particles, F32))
    return fields


def value_at(fields: TiledFields, particle: int, x: float, y: float) -> float:
    return float(fields.look_up(np.array([particle]), np.array([[x]], F32), np.array([[y]], F32))[0][0, 0])


def test_copies_share_tiles_until_one_writes() -> None:
    fields = stamped(TiledFields(4, 0.05, 0.06), [0.5], [0.5])
    fields.resample(np.array([2, 2, 2, 2]))
    shared = fields.used_bytes() - fields.tables.nbytes
    assert shared <= 4 * AREA
    x = np.array([[1.0], [1.0], [1.0], [1.2]], F32)
    fields.stamp(x, np.full((4, 1), 1.0, F32))
    assert value_at(fields, 3, 1.2, 1.0) > 0.75
    assert value_at(fields, 0, 1.2, 1.0) < 0.2
    assert value_at(fields, 0, 0.5, 0.5) > 0.75


def test_a_field_peaks_where_it_was_stamped() -> None:
    for x in (0.51, 0.523, 0.537, 0.548):
        fields = stamped(TiledFields(1, 0.05, 0.06), [x], [0.52])
        along = np.linspace(x - 0.05, x + 0.05, 101).astype(F32)
        value, slope, _ = fields.look_up(np.zeros(1, int), along[None], np.full((1, 101), 0.52, F32))
        assert abs(along[int(value.argmax())] - x) < 0.026
        assert slope[0, 10] > 0 > slope[0, 90]


def test_growing_tables_move_nothing() -> None:
    fields = stamped(TiledFields(2, 0.05, 0.06), [0.5, -3.0], [0.5, 2.0])
    before = value_at(fields, 1, -3.0, 2.0)
    fields.cover(np.array([-60.0, -5.0]), np.array([5.0, 90.0]))
    assert value_at(fields, 1, -3.0, 2.0) == before


def test_systematic_resampling_gives_everyone_their_share() -> None:
    weights = np.array([0.1, 0.4, 0.05, 0.45])
    for offset in (0.0, 0.3, 0.99):
        counts = np.bincount(systematic(np.repeat(weights / 25, 25), offset, 100) // 25, minlength=4)
        assert np.all(np.abs(counts - 100 * weights) <= 1)


def apart(n: int, spread_m: float) -> NDArray[np.float64]:
    """(n, 3) poses in two heaps, one sigma `spread_m` in all."""
    poses = np.zeros((n, 3))
    poses[: n // 2, 0], poses[n // 2 :, 0] = -spread_m, spread_m
    return poses


def test_the_number_of_particles_follows_their_spread() -> None:
    even = np.full(30, 1.0 / 30)
    wanted = [wanted_particles(apart(30, spread_m), even, 30) for spread_m in (0.0, 0.004, 0.01, 0.05, 0.1, 0.2, 5.0)]
    assert wanted == [10, 19, 30, 30, 42, 60, 60]
    assert wanted_particles(apart(1, 0.0), np.ones(1), 1) == 1


def test_particles_far_apart_become_more_and_settled_ones_fewer() -> None:
    wall = np.stack([np.linspace(-1, 1, 41), np.full(41, 1.0)], axis=1).astype(F32)
    surfels = np.column_stack([wall, np.zeros(41), np.ones(41)]).astype(F32)
    particles = ParticleFilter(12, 0.05, np.random.default_rng(0))
    particles.start(wall)
    particles.poses = apart(12, 0.5)
    particles.update(np.zeros(3), (0.02, 0.01), surfels, wall)
    assert particles.particles == 24 == particles.fields.particles == len(particles.next_parents)
    particles.poses = np.zeros((24, 3))
    particles.log_weights[1:] = -9.0
    particles._resample_when_needed()
    assert particles.particles == 4 == particles.fields.particles == len(particles.log_weights)
    assert particles.followed == 0


def test_the_followed_particle_lives_on_in_its_first_copy() -> None:
    assert heir(np.array([0, 0, 3, 3, 5]), 3) == 2
    assert heir(np.array([0, 0, 3, 3, 5]), 9) == 4


def test_the_followed_line_is_the_path_of_ancestors() -> None:
    mapper = Mapper(MappingOptions(particles=6), seed=1)
    drive(mapper, 12.0)
    particles = mapper.map.filter
    particle, expected = int(particles.next_parents[particles.followed]), []
    for k in range(len(particles.path) - 1, -1, -1):
        expected.append(particles.path[k][particle])
        particle = int(particles.parents[k][particle])
    assert np.array_equal(particles.line, np.array(expected[::-1]))


def test_what_all_particles_agree_on_is_forgotten_and_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    wall = np.stack([np.linspace(-1, 1, 41), np.full(41, 1.0)], axis=1).astype(F32)
    surfels = np.column_stack([wall, np.zeros(41), np.ones(41)]).astype(F32)
    lines = []
    for agreed_every in (3, 10_000):
        monkeypatch.setattr(particle_filter, "AGREED_EVERY", agreed_every)
        particles = ParticleFilter(6, 0.05, np.random.default_rng(0))
        particles.start(wall)
        for k in range(30):
            if k % 7 == 3:
                particles.log_weights[np.arange(particles.particles) != k % particles.particles] = -9.0
            particles.update(np.array([0.01, 0.0, 0.0]), (0.02, 0.01), surfels, wall)
        lines.append(particles.line)
        assert len(particles.path) == len(particles.lineage) == 31 - particles.forgotten
        assert (particles.forgotten > 20) == (agreed_every == 3)
    assert np.array_equal(*lines)
