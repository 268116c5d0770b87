"""Fusion: agreement kept, conflict unknown, walls whole, and the order of joining irrelevant."""

from __future__ import annotations

import math
import tracemalloc

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from agent.merging.errors import FusionError
from agent.merging.fusion import MAX_FUSED_CELLS, fuse
from protocol.geometry import SE2
from protocol.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

HERE = SE2(0.0, 0.0, 0.0)


def room(resolution_m: float = 0.05, origin: SE2 = HERE) -> OccupancyGrid:
    """A 6 m x 4 m room with a diagonal screen and a pillar, walls one cell thick."""
    h, w = round(4 / resolution_m), round(6 / resolution_m)
    cells = np.full((h + 8, w + 8), UNKNOWN, np.int8)
    cv2.rectangle(cells, (4, 4), (w + 3, h + 3), FREE, -1)
    cv2.rectangle(cells, (4, 4), (w + 3, h + 3), OCCUPIED, 1)
    cv2.line(cells, (w // 6, h // 5), (w // 2, h - h // 6), OCCUPIED, 1)
    cv2.circle(cells, (3 * w // 4, h // 2), h // 5, OCCUPIED, 1)
    return OccupancyGrid(cells, resolution_m, origin)


def pieces_of_wall(grid: OccupancyGrid) -> int:
    return int(cv2.connectedComponents((grid.cells == OCCUPIED).astype(np.uint8), connectivity=8)[0]) - 1


small_grids = st.builds(
    OccupancyGrid,
    hnp.arrays(
        np.int8, hnp.array_shapes(min_dims=2, max_dims=2, max_side=12), elements=st.sampled_from([UNKNOWN, FREE, OCCUPIED])
    ),
    st.sampled_from([0.05, 0.07, 0.1, 0.2]),
    st.builds(SE2, st.floats(-2, 2), st.floats(-2, 2), st.floats(-4, 4)),
)
placed_grids = st.tuples(small_grids, st.builds(SE2, st.floats(-2, 2), st.floats(-2, 2), st.floats(-7, 7)))


@settings(deadline=None)
@given(st.lists(placed_grids, min_size=1, max_size=4), st.randoms(use_true_random=False))
def test_the_order_in_which_maps_join_never_changes_a_bit(maps, random):
    shuffled = random.sample(maps, len(maps))
    assert fuse(maps).grid.content_hash() == fuse(shuffled).grid.content_hash()
    assert fuse(maps).conflicting_cells == fuse(shuffled).conflicting_cells


@settings(deadline=None)
@given(placed_grids)
def test_a_map_always_agrees_with_itself(placed):
    once, twice = fuse([placed]), fuse([placed, placed])
    assert np.array_equal(once.grid.cells, twice.grid.cells)
    assert twice.conflicting_cells == 0
    assert twice.agreeing_cells == np.count_nonzero(once.grid.known())


@settings(deadline=None)
@given(st.lists(placed_grids, min_size=1, max_size=3))
def test_every_processor_fuses_the_same_bits(maps):
    hashes = []
    for is_optimized in (True, False):
        cv2.setUseOptimized(is_optimized)
        hashes.append(fuse(maps).grid.content_hash())
    cv2.setUseOptimized(True)
    assert hashes[0] == hashes[1]


@settings(deadline=None)
@given(st.lists(placed_grids, min_size=2, max_size=4))
def test_fusion_invents_no_knowledge(maps):
    fused = fuse(maps).grid
    for value in (FREE, OCCUPIED):
        if (fused.cells == value).any():
            assert any((grid.cells == value).any() for grid, _ in maps)


def test_a_map_on_the_lattice_comes_back_to_the_bit():
    grid = room(origin=SE2(-1.0, 2.5, 0.0))
    fused = fuse([(grid, SE2(3.0, -7.25, 0.0))]).grid.cropped()
    assert np.array_equal(fused.cells, grid.cropped().cells)
    assert fused.origin.x_m == pytest.approx(3.0 - 1.0 + 0.2)
    assert fused.origin.y_m == pytest.approx(-7.25 + 2.5 + 0.2)


@pytest.mark.parametrize("yaw_deg", range(0, 360, 15))
@pytest.mark.parametrize("resolution_m", [0.05, 0.025, 0.08])
def test_walls_stay_whole_and_thin_however_they_are_turned(yaw_deg, resolution_m):
    grid = room()
    fused = fuse([(grid, SE2(0.017, -0.031, math.radians(yaw_deg)))], resolution_m).grid
    assert pieces_of_wall(fused) == pieces_of_wall(grid)
    length_m = np.count_nonzero(grid.cells == OCCUPIED) * 0.05
    thickness_m = np.count_nonzero(fused.cells == OCCUPIED) * resolution_m**2 / length_m
    assert 0.9 <= thickness_m / max(0.05, resolution_m) <= 1.35


def test_a_conflicting_cell_becomes_unknown():
    empty = np.zeros((20, 20), np.int8)
    with_box = empty.copy()
    with_box[8:12, 8:12] = OCCUPIED
    fused = fuse([(OccupancyGrid(empty, 0.1), HERE), (OccupancyGrid(with_box, 0.1), HERE)])
    expected = empty.copy()
    expected[8:12, 8:12] = UNKNOWN
    assert np.array_equal(fused.grid.cropped().cells, expected)
    assert (fused.conflicting_cells, fused.agreeing_cells) == (16, 384)
    assert fused.consistency == pytest.approx(0.96)


@pytest.mark.parametrize("shift_m", [0.01, 0.02, 0.03, 0.045])
def test_a_wall_shifted_by_under_a_cell_is_no_conflict(shift_m):
    grid = room()
    fused = fuse([(grid, HERE), (grid, SE2(shift_m, shift_m, 0.0))])
    assert fused.conflicting_cells == 0
    assert pieces_of_wall(fused.grid) == pieces_of_wall(grid)


def test_a_wall_shifted_by_three_cells_is_a_conflict():
    grid = room()
    assert fuse([(grid, HERE), (grid, SE2(0.15, 0.0, 0.0))]).conflicting_cells > 20


def test_a_coarse_map_does_not_thicken_the_walls_of_a_fine_one():
    fine, coarse = room(0.05), room(0.2, SE2(-0.6, -0.6, 0.0))  # the same room: both frames have its corner 4 cells in
    alone = np.count_nonzero(fuse([(fine, HERE)]).grid.cells == OCCUPIED)
    fused = fuse([(fine, HERE), (coarse, HERE)])
    assert fused.grid.resolution_m == 0.05
    assert np.count_nonzero(fused.grid.cells == OCCUPIED) < 1.15 * alone
    assert fused.consistency > 0.96


def test_what_only_one_map_knows_is_kept():
    left, right = np.zeros((4, 4), np.int8), np.full((4, 4), OCCUPIED, np.int8)
    fused = fuse([(OccupancyGrid(left, 0.5), HERE), (OccupancyGrid(right, 0.5), SE2(2.0, 0.0, 0.0))])
    assert np.array_equal(fused.grid.cropped().cells, np.hstack([left, right]))
    assert fused.agreeing_cells == fused.conflicting_cells == 0
    assert fused.consistency == 1.0


def test_three_hundred_maps_are_no_trouble():
    maps = [(room(0.1), SE2(0.0003 * i, 0.0, 0.0)) for i in range(300)]
    assert fuse(maps).consistency > 0.9


def test_fusing_many_maps_takes_little_more_room_than_the_one_they_make():
    maps = [(room(0.02).cropped(), SE2(0.1 * k, 0.0, 0.3)) for k in range(12)]
    fuse(maps)
    tracemalloc.start()
    try:
        fused = fuse(maps)
        peak_bytes = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak_bytes < 25 * fused.grid.cells.size


@pytest.mark.parametrize("cells", [np.full((0, 0), UNKNOWN, np.int8), np.full((5, 7), UNKNOWN, np.int8)])
def test_maps_that_know_nothing_fuse_to_one_unknown_cell(cells):
    fused = fuse([(OccupancyGrid(cells, 0.05), SE2(1.0, 2.0, 3.0))])
    assert fused.grid.cells.tolist() == [[UNKNOWN]]


@pytest.mark.parametrize(
    ("maps", "resolution_m", "says"),
    [
        ([], None, "no maps"),
        ([(room(), SE2(math.nan, 0, 0))], None, "map 0 of 1"),
        ([(room(), SE2(0, 1e300, 0))], None, "map 0 of 1"),
        ([(room(), HERE), (room(), SE2(1e6, 1e6, 0))], None, f"{MAX_FUSED_CELLS:,} cells"),
        ([(room(), HERE), (room(), SE2(5e3, 0, 0))], None, "32,000 a side"),
        ([(OccupancyGrid(np.zeros((2, 30_000), np.int8), 0.01), SE2(0, 0, 0.8))], 0.05, "32,000 a side"),
        ([(OccupancyGrid(np.zeros((2, 2), np.int8), -0.1), HERE)], None, "resolution of -0.1"),
        ([(room(), HERE)], math.inf, "target resolution of inf"),
        ([(room(), HERE)], 0.0, "target resolution of 0.0"),
    ],
)
def test_what_cannot_be_fused_is_refused_in_one_sentence(maps, resolution_m, says):
    with pytest.raises(FusionError, match=says):
        fuse(maps, resolution_m)
