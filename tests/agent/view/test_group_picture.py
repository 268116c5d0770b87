"""The picture of three maps and more: who alone knows a wall, what several agree on, and who did not join."""

from __future__ import annotations

import numpy as np

from agent.view.group_picture import A_ROW, CONFLICT, SEVERAL, Member, group_picture
from agent.view.render import robot_colour
from agent.view.sheet import FAINT, WIDTH
from protocol.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

SIDE = 60


def member(name: str, row: int | None, *, joined: bool = True) -> Member:
    """A room with one wall in that row."""
    cells = np.full((SIDE, SIDE), FREE, np.int8)
    if row is not None:
        cells[row, 5:-5] = OCCUPIED
    return Member(name, OccupancyGrid(cells, 0.05), cells if joined else None)


def shows(picture: np.ndarray, colour: tuple[int, int, int]) -> int:
    """Pixels below the maps themselves."""
    return int((picture[-1000:] == colour).all(axis=2).sum())


def drawn(members: list[Member]) -> np.ndarray:
    fused = np.full((SIDE, SIDE), FREE, np.int8)
    conflicts = np.zeros(fused.shape, np.bool_)
    conflicts[50, 50] = True
    fused[[10, 20], 5:-5], fused[conflicts] = OCCUPIED, UNKNOWN
    return group_picture(members, OccupancyGrid(fused, 0.05), conflicts, ["1 cell conflicts"])


def test_a_wall_has_its_maps_colour_until_another_knows_it_too() -> None:
    picture = drawn([member("a", 10), member("b", 10), member("c", 20)])
    assert picture.shape[1] == WIDTH
    assert shows(picture, SEVERAL) > 10_000
    assert shows(picture, robot_colour(2)) > 10_000
    assert shows(picture, robot_colour(0)) == 0
    assert shows(picture, CONFLICT) > 100


def test_a_map_that_did_not_join_is_shown_faint_and_nowhere_below() -> None:
    picture = drawn([member("a", 10), member("b", 10), member("c", 40, joined=False)])
    assert int((picture[:-1000] == FAINT).all(axis=2).sum()) > 300
    assert shows(picture, robot_colour(2)) == 0


def test_many_maps_stand_in_rows() -> None:
    few, many = drawn([member(str(i), 10) for i in range(A_ROW)]), drawn([member(str(i), 10) for i in range(A_ROW + 1)])
    assert many.shape[0] > few.shape[0] + 300
