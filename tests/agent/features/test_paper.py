"""The paper's features: every cell explained once, sizes in metres, frames respected."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from agent.features.paper import paper_features
from protocol.geometry import SE2
from protocol.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from tests.harness.floorplans import office

any_cells = hnp.arrays(
    np.int8,
    hnp.array_shapes(min_dims=2, max_dims=2, min_side=0, max_side=40),
    elements=st.sampled_from([UNKNOWN, FREE, OCCUPIED]),
)


def drawn(origin: SE2 = SE2(0.0, 0.0, 0.0)) -> OccupancyGrid:
    """A 5 m line, a circle of 1 m radius, and a bent curve, at 5 cm."""
    cells = np.zeros((200, 200), np.int8)
    cv2.line(cells, (20, 20), (120, 20), OCCUPIED, 1)
    cv2.circle(cells, (60, 100), 20, OCCUPIED, 1)
    cv2.ellipse(cells, (150, 120), (18, 45), 0, -80, 80, OCCUPIED, 1)
    return OccupancyGrid(cells, 0.05, origin)


def between_lines_rad(a_rad: float, b_rad: float) -> float:
    """Smallest angle between two lines without direction."""
    return abs(math.remainder(a_rad - b_rad, math.pi))


def test_a_line_has_its_length_centre_and_slope():
    longest = paper_features(drawn()).lines[0]
    assert longest[:2] == pytest.approx([3.525, 1.025], abs=0.03)
    assert longest[2] == pytest.approx(5.0, abs=0.15)
    assert between_lines_rad(longest[3], 0.0) < 0.01


def test_a_circle_has_its_centre_and_radius():
    assert any(np.allclose(circle[:3], [3.025, 5.025, 1.0], atol=0.08) for circle in paper_features(drawn()).circles)


def test_what_is_neither_is_a_curve():
    cells = np.zeros((100, 100), np.int8)
    turns = np.linspace(0, 3 * math.pi, 400)
    x, y = 50 + 0.07 * turns * 40 / math.pi * np.cos(turns) * 3, 50 + 12 * np.sin(2.2 * turns)
    cells[y.astype(int), x.astype(int)] = OCCUPIED
    features = paper_features(OccupancyGrid(cells, 0.1))
    assert len(features.curves) >= 1
    assert features.curves[0, 2] <= np.count_nonzero(cells) * 0.1


def test_the_origin_of_the_map_moves_its_features_along():
    here, there = paper_features(drawn()), paper_features(drawn(SE2(4.0, -1.0, 1.0)))
    assert there.lines[:, :2] == pytest.approx(SE2(4.0, -1.0, 1.0).apply(here.lines[:, :2]))
    assert all(between_lines_rad(t - h, 1.0) < 1e-9 for h, t in zip(here.lines[:, 3], there.lines[:, 3], strict=True))


@pytest.mark.parametrize("resolution_m", [0.05, 0.1, 0.2])
def test_features_of_a_floor_plan_are_few_and_long(resolution_m):
    features = paper_features(office(1).mapped(SE2(0, 0, 0.4), resolution_m))
    assert 15 <= len(features.lines) <= 90
    assert features.lines[:, 2].sum() > 60


@settings(deadline=None)
@given(any_cells)
def test_no_cells_whatever_upset_it(cells):
    for kind in (features := paper_features(OccupancyGrid(cells, 0.1))).lines, features.circles, features.curves:
        assert np.isfinite(kind).all()


def test_walls_beyond_any_building_are_looked_at_more_coarsely():
    dust = np.where(np.random.default_rng(0).random((1500, 1500)) < 0.1, OCCUPIED, FREE).astype(np.int8)
    cv2.line(dust, (100, 100), (1400, 100), OCCUPIED, 3)
    features = paper_features(OccupancyGrid(dust, 0.05))
    assert len(features) <= 3 * 120
    assert features.lines[0, 2] > 5


def test_a_checkerboard_is_bounded_work():
    cells = np.where(np.indices((300, 300)).sum(axis=0) % 2, OCCUPIED, FREE).astype(np.int8)
    assert len(paper_features(OccupancyGrid(cells, 0.05))) <= 3 * 120
