"""`merge_arrays`: merging as one function on plain arrays."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings

from agent.merging import fuse_arrays, merge_arrays
from agent.merging.errors import MapArrayError
from protocol.geometry import SE2, wrap_angle
from tests.agent.features.test_paper import any_cells
from tests.harness.floorplans import office


def test_two_arrays_come_together_corner_to_corner():
    plan, T_a, T_b = office(2), SE2(1.0, 2.0, -0.4), SE2(0.0, 0.0, 1.9)
    a, b = plan.mapped(T_a, 0.1, (-1, 18.0)), plan.mapped(T_b, 0.1, (9.0, 1e3))
    result = merge_arrays(a.cells, b.cells.astype(np.int64), 0.1)
    truth = a.origin.inverse() @ T_a @ T_b.inverse() @ b.origin
    assert result.accepted
    assert result.T_ours_theirs.distance_m(truth) < 0.1
    assert abs(wrap_angle(result.T_ours_theirs.theta_rad - truth.theta_rad)) < 0.006
    fused = fuse_arrays(a.cells, b.cells, 0.1, result.T_ours_theirs)
    assert fused.consistency > 0.97
    assert fused.grid.known_area_m2() == pytest.approx(plan.width_m * plan.height_m, rel=0.05)


def test_a_small_map_on_a_large_canvas_is_the_same_map():
    plan = office(2)
    a, b = plan.mapped(SE2(0, 0, 0.3), 0.1, (-1, 18.0)).cells, plan.mapped(SE2(0, 0, 1.1), 0.1, (9.0, 1e3)).cells
    canvas = np.full((1500, 2000), -1, np.int8)
    canvas[40 : 40 + b.shape[0], 1000 : 1000 + b.shape[1]] = b
    alone, on_canvas = (merge_arrays(a, theirs, 0.1) for theirs in (b, canvas))
    assert on_canvas.accepted
    assert alone.T_ours_theirs.distance_m(on_canvas.T_ours_theirs @ SE2(100.0, 4.0, 0.0)) < 0.01


def test_probabilities_between_are_read_with_nav2s_thresholds():
    cells = np.array([[0, 25, 26], [64, 65, 100], [-1, -1, -1]])
    fused = fuse_arrays(cells, cells, 0.1, SE2.identity())
    assert fused.grid.cells.tolist() == [[0, 0, -1], [-1, 100, 100]]


@settings(max_examples=40, deadline=None)
@given(any_cells, any_cells)
def test_no_arrays_whatever_upset_it(a, b):
    result = merge_arrays(a, b, 0.05, 0.1)
    assert result.T_ours_theirs is None or result.T_ours_theirs.is_finite()


@pytest.mark.parametrize(
    ("cells", "resolution_m", "says"),
    [
        (np.zeros((2, 2)), 0.1, "float64"),
        (np.zeros(4, np.int8), 0.1, "1 dimensions"),
        (np.full((2, 2), 205), 0.1, "205"),
        (np.full((2, 2), -3), 0.1, "-3"),
        (np.zeros((2, 2), np.int8), 0.0, "resolution of 0.0"),
        (np.zeros((2, 2), np.int8), math.nan, "resolution of nan"),
    ],
)
def test_what_is_no_map_is_refused_in_one_sentence(cells, resolution_m, says):
    with pytest.raises(MapArrayError, match=says):
        merge_arrays(cells, cells, resolution_m)
