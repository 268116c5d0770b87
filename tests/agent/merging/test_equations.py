"""The match factor: the warp-based counts equal the obvious ones."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from agent.merging.equations import FactorCounter, match_factor
from agent.merging.result import MatchFactor
from protocol.geometry import SE2
from protocol.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from tests.harness.oracles import match_factor_counts

grids = st.builds(
    OccupancyGrid,
    hnp.arrays(
        np.int8, hnp.array_shapes(min_dims=2, max_dims=2, max_side=15), elements=st.sampled_from([UNKNOWN, FREE, OCCUPIED])
    ),
    st.sampled_from([0.05, 0.1, 0.2]),
    st.builds(SE2, st.floats(-1, 1), st.floats(-1, 1), st.floats(-4, 4)),
)
transforms = st.builds(SE2, st.floats(-2, 2), st.floats(-2, 2), st.floats(-7, 7))


@settings(deadline=None)
@given(grids, grids, transforms)
def test_fast_counts_are_the_obvious_counts(ours, theirs, T_ours_theirs):
    agree, disagree, on_an_edge = match_factor_counts(ours, theirs, T_ours_theirs)
    factor = match_factor(ours, theirs, T_ours_theirs)
    assert abs(factor.agree - agree) <= on_an_edge
    assert abs(factor.disagree - disagree) <= on_an_edge


@settings(deadline=None)
@given(grids, st.integers(-20, 20), st.integers(-20, 20), st.integers(0, 3))
def test_whole_cells_and_quarter_turns_are_exact(grid, rows, cols, quarter_turns):
    theirs = OccupancyGrid(np.rot90(grid.cells, quarter_turns), 1.0)
    ours = OccupancyGrid(grid.cells, 1.0)
    T = SE2(cols, rows, 0.0) @ _quarter_turns_back(quarter_turns, *grid.cells.shape)
    shifted = OccupancyGrid(grid.cells, 1.0, SE2(cols, rows, 0.0))
    counts = match_factor_counts(ours, shifted, SE2.identity())
    assert (match_factor(ours, theirs, T).agree, match_factor(ours, theirs, T).disagree) == counts[:2]


def _quarter_turns_back(n: int, height: int, width: int) -> SE2:
    """From the frame of `np.rot90(cells, n)` (rows grow upwards, so it turns clockwise) back to that of `cells`."""
    corner = {0: (0, 0), 1: (width, 0), 2: (width, height), 3: (0, height)}[n]
    return SE2(*corner, n * math.pi / 2)


def test_a_map_agrees_with_itself_in_every_known_cell():
    cells = np.array([[UNKNOWN, FREE, OCCUPIED], [FREE, FREE, UNKNOWN]], np.int8)
    grid = OccupancyGrid(cells, 0.1, SE2(1, 2, 0.3))
    assert match_factor(grid, grid, SE2.identity()) == MatchFactor(4, 0)
    assert match_factor(grid, grid, SE2.identity()).value == 1.0


def test_opposite_maps_disagree_everywhere():
    free, wall = OccupancyGrid(np.zeros((4, 4), np.int8), 0.1), OccupancyGrid(np.full((4, 4), OCCUPIED, np.int8), 0.1)
    assert match_factor(free, wall, SE2.identity()) == MatchFactor(0, 16)


@pytest.mark.parametrize(
    "T", [SE2(1e9, 0, 0), SE2(math.nan, 0, 0), SE2(0, math.inf, 1), SE2(1e300, -1e300, 0), SE2(0, 0, math.nan)]
)
def test_maps_that_do_not_meet_have_factor_zero(T):
    grid = OccupancyGrid(np.zeros((4, 4), np.int8), 0.1)
    assert match_factor(grid, grid, T).value == 0.0


def test_empty_maps_are_no_trouble():
    nothing = OccupancyGrid(np.zeros((0, 0), np.int8), 0.1)
    assert FactorCounter.of(nothing, OccupancyGrid.empty(0.05)).at(SE2.identity()) == MatchFactor(0, 0)
