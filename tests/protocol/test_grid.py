"""Grids under points."""

from __future__ import annotations

import numpy as np
import pytest

from protocol.geometry import SE2
from protocol.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid


@pytest.mark.parametrize("step", [1, 2, 5])
def test_walls_around_are_those_of_nine_looks(step: int) -> None:
    rng = np.random.default_rng(step)
    cells = rng.choice(np.array([UNKNOWN, FREE, OCCUPIED], np.int8), (12, 17), p=(0.3, 0.6, 0.1))
    grid = OccupancyGrid(cells, 0.1, SE2(-0.3, 0.4, 0.0))
    centres = np.argwhere(np.ones((60, 70), bool)) - 25
    points_m = grid.points_of(centres)
    steps_m = (-0.1 * step, 0.0, 0.1 * step)
    looks = [grid.values_at(points_m + np.array([dx, dy])) == OCCUPIED for dx in steps_m for dy in steps_m]
    expected = np.any(looks, axis=0)
    assert 0 < expected.sum() < len(expected) / 2
    np.testing.assert_array_equal(grid.walls_around(points_m, 0.1 * step), expected)


def test_no_point_has_no_wall_around_it() -> None:
    assert OccupancyGrid(np.full((2, 2), OCCUPIED, np.int8), 0.1).walls_around(np.zeros((0, 2)), 0.1).shape == (0,)
