"""What two maps of one place never say of each other, and two places of one kind do."""

from __future__ import annotations

import numpy as np
import pytest

from agent.features.snapshot import MapSnapshot
from agent.merging.doubts import Doubts, doubts, turning
from agent.merging.views import witness
from protocol.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

SAME_FRAME = np.zeros((1, 3))


def hall(outline: str) -> MapSnapshot:
    """A round hall of 10 m, or a square one."""
    rows, cols = np.mgrid[:120, :120] - 60.0
    away = np.hypot(rows, cols) if outline == "round" else np.maximum(abs(rows), abs(cols))
    cells = np.where(away < 50, FREE, UNKNOWN).astype(np.int8)
    cells[(away >= 50) & (away < 51)] = OCCUPIED
    return MapSnapshot.of(OccupancyGrid(cells, 0.1))


def test_round_walls_do_not_say_how_they_are_turned_and_square_ones_do() -> None:
    round_m, square_m = (
        turning(witness(hall(outline)), witness(hall(outline)), SAME_FRAME[0]) for outline in ("round", "square")
    )
    assert round_m < 1.0
    assert square_m > 6.0


def room(*things: tuple[slice, slice]) -> MapSnapshot:
    """A room of 12 by 9 m with some things in it."""
    cells = np.full((110, 140), UNKNOWN, np.int8)
    cells[9:101, 9:131] = OCCUPIED
    cells[10:100, 10:130] = FREE
    for thing in things:
        cells[thing] = OCCUPIED
    return MapSnapshot.of(OccupancyGrid(cells, 0.1))


def said(ours: MapSnapshot, theirs: MapSnapshot) -> Doubts:
    return doubts(witness(ours), witness(theirs), SAME_FRAME[0])


WALL, PARTS_OF_IT = np.s_[55:57, 30:110], (np.s_[55:57, 10:70], np.s_[55:57, 85:130])
BOX, ANOTHER = np.s_[30:36, 30:36], np.s_[70:76, 80:86]


def test_a_wall_across_the_other_maps_free_space_is_measured_whole() -> None:
    both_sides = 2
    assert said(room(), room(WALL)).stretch_m == pytest.approx(8.0 * both_sides, abs=1.5)
    assert said(room(*PARTS_OF_IT), room()).stretch_m == pytest.approx(5.5 * both_sides, abs=1.5)  # the larger of two
    assert said(room(WALL), room(WALL)).stretch_m == 0.0


def test_things_that_stand_elsewhere_are_astray() -> None:
    same, moved = said(room(BOX), room(BOX)), said(room(BOX), room(ANOTHER))
    assert (same.astray_m, moved.loose_m) == (0.0, 0.0)
    assert same.loose_m == moved.astray_m > 1.0
