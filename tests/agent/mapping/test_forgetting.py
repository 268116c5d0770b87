"""A path of days is shortened, and nothing that is drawn, remembered or said changes by it."""

from __future__ import annotations

import numpy as np
import pytest

from agent.mapping import forgetting, kept_scans, particle_filter, redrawing
from agent.mapping.mapper import Mapper
from agent.mapping.options import MappingOptions
from agent.mapping.path_graph import LoopEdge
from hw.readings import LaserScan, Odometry
from protocol.geometry import SE2
from tests.agent.mapping.worlds import ROOMS, DriftingOdometry, rounds, scan_at

OPTIONS = MappingOptions(particles=4)
MOST = 60


def drawn(readings: list[tuple[Odometry, LaserScan]], saved_at: int = -1) -> Mapper:
    mapper = Mapper(OPTIONS, seed=3)
    for k, (odometry, scan) in enumerate(readings):
        mapper.add_odometry(odometry)
        mapper.add_scan(scan)
        if k == saved_at:
            mapper = Mapper.restore(mapper.checkpoint(), OPTIONS)
    return mapper


def test_a_path_that_is_shortened_and_saved_leads_to_the_same_map(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kept_scans, "ALL_ROUND_PLACE_M", 4.0)
    monkeypatch.setattr(redrawing, "FEWEST_TO_THIN", 20)
    monkeypatch.setattr(redrawing, "NEVER_THINNED", 10)
    monkeypatch.setattr(forgetting, "NEVER_THINNED", 10)
    monkeypatch.setattr(particle_filter, "AGREED_EVERY", 8)
    monkeypatch.setattr(particle_filter, "KEPT_KEYFRAMES", 20)
    rng = np.random.default_rng(5)
    wheels = DriftingOdometry(rng)
    readings = [(wheels.sample(s, pose), scan_at(ROOMS, pose, s, rng, 90)) for s, pose in rounds(70.0, hz=2.0)]
    whole = drawn(readings)
    monkeypatch.setattr(forgetting, "MOST_KEYFRAMES", MOST)
    short = drawn(readings, saved_at=100)
    assert len(short.map.filter.line) < MOST < 0.8 * len(whole.map.filter.line)
    assert short.estimate().grid.content_hash() == whole.estimate().grid.content_hash()
    assert short.map.trajectory() == pytest.approx(whole.map.trajectory(), abs=1e-5)


def test_loops_and_breaks_keep_their_places(monkeypatch: pytest.MonkeyPatch) -> None:
    mapper = drawn([(Odometry(0.0, 0.0, 0.0, 0.0), scan_at(ROOMS, SE2(0.0, 0.0, 0.0), 0.0, np.random.default_rng(0), 90))])
    local = mapper.map
    n, seen = 300, local.drawing.scans[0]
    line = np.stack([np.arange(n) * 0.3, np.zeros(n), np.zeros(n)], axis=1)
    local.filter.line = local.drawing.poses = line
    local.filter.forgotten = 290
    local.drawing.scans = dict.fromkeys([0, 50, 100, *range(250, n)], seen)
    local.loops.edges, local.loops.breaks, local.loops.next_look = [LoopEdge(30, 150, SE2(1.0, 0.0, 0.0))], [90, 150, 300], 304
    local.loops.known = 150
    monkeypatch.setattr(forgetting, "MOST_KEYFRAMES", n)
    forgetting.forget_keyframes(local)
    [edge] = local.loops.edges
    x_m = local.filter.line[:, 0] / 0.3
    assert np.round(x_m[:6]).tolist() == [0, 30, 50, 100, 150, 200]
    assert np.array_equal(local.filter.line, local.drawing.poses)
    assert [round(float(x_m[k])) for k in (edge.a, edge.b, local.loops.known)] == [30, 150, 150]
    assert [round(float(x_m[k])) for k in list(local.drawing.scans)[:4]] == [0, 50, 100, 250]
    assert [round(float(x_m[k])) for k in local.loops.breaks[:2]] == [100, 150]  # the step that leads there is broken
    assert local.loops.breaks[2] == len(x_m)
    assert local.loops.next_look == len(x_m) + 4
