"""Laws of a robot's word: growing takes nothing back, moving is found again, inventing is seen by others."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from agent.fleet.broken_word import grown, share_found_again, taken_back, witnessed
from protocol.geometry import SE2
from protocol.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from tests.fleet.explorer import random_world

WORLD = random_world(3, 48.0, 0.5, walls=60)
CHANGES: dict[str, Callable[[OccupancyGrid], OccupancyGrid]] = {
    "shifted": lambda grid: replace(grid, origin=grid.origin @ SE2(2.5, -3.0, 0.0)),
    "turned a little": lambda grid: replace(grid, origin=SE2(0.0, 0.0, 0.04) @ grid.origin),
    "mirrored": lambda grid: replace(grid, cells=np.ascontiguousarray(grid.cells[:, ::-1])),
    "all free": lambda grid: replace(grid, cells=np.full_like(grid.cells, FREE)),
    "all occupied": lambda grid: replace(grid, cells=np.full_like(grid.cells, OCCUPIED)),
    "another place": lambda grid: random_world(4, 48.0, 0.5, walls=60),
}


def part(grid: OccupancyGrid, columns: int) -> OccupancyGrid:
    """Only the first columns are known yet."""
    cells = grid.cells.copy()
    cells[:, columns:] = UNKNOWN
    return replace(grid, cells=cells).cropped()


def with_wall(grid: OccupancyGrid, column: int, value: int) -> OccupancyGrid:
    cells = grid.cells.copy()
    cells[20:60, column] = value
    return replace(grid, cells=cells)


def test_a_map_that_grows_takes_nothing_back() -> None:
    change = taken_back(part(WORLD, 40), WORLD)
    assert len(change.points_m) == 0
    assert witnessed(change, WORLD, SE2.identity()).plain == 0.0
    assert np.array_equal(grown(part(WORLD, 40), WORLD).cells, WORLD.cells)


def test_what_was_said_first_stays_the_word() -> None:
    first = part(with_wall(WORLD, 30, OCCUPIED), 40)
    word = grown(first, with_wall(WORLD, 30, FREE))
    assert word.values_at(WORLD.points_of([[40, 30], [40, 60]])).tolist() == [OCCUPIED, int(WORLD.cells[40, 60])]


@pytest.mark.parametrize(("before", "after"), [(FREE, OCCUPIED), (OCCUPIED, FREE)])
def test_walls_that_come_and_go_are_contradicted_by_whoever_sees_them(before: int, after: int) -> None:
    clear = WORLD.cells.copy()
    clear[18:62, 26:35] = FREE
    honest = with_wall(replace(WORLD, cells=clear), 30, before)
    T_witness_map = SE2(3.0, -2.0, 0.5)
    witness = replace(honest, origin=T_witness_map @ honest.origin)
    change = taken_back(honest, with_wall(honest, 30, after))
    assert len(change.points_m) == 40
    assert witnessed(change, witness, T_witness_map).plain == pytest.approx(40 / honest.cells.size, rel=0.1)
    other_wing = part(witness, 20)
    assert witnessed(change, other_wing, T_witness_map).plain == 0.0  # who was not there says nothing


def test_a_wall_that_moves_by_one_cell_is_told_apart() -> None:
    clear = WORLD.cells.copy()
    clear[18:62, 26:35] = FREE
    honest = with_wall(replace(WORLD, cells=clear), 30, OCCUPIED)
    change = taken_back(honest, with_wall(with_wall(honest, 30, FREE), 31, OCCUPIED))
    said = witnessed(change, honest, SE2.identity())
    assert change.is_near.all()
    assert said.plain == 0.0 < said.near


@pytest.mark.parametrize("name", CHANGES)
def test_a_redrawn_map_is_found_again_and_an_invention_is_not(name: str) -> None:
    share = share_found_again(WORLD, CHANGES[name](WORLD))
    assert share > 0.6 if name in ("shifted", "turned a little") else share < 0.3
