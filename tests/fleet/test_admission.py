"""Maps that are redrawn: an honest robot's is checked again and taken back, never punished."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from protocol.geometry import SE2
from protocol.grid import OccupancyGrid
from tests.fleet.attackers import Liar
from tests.fleet.simulation import Explorer, Fleet, random_world

NAMES = ["r0", "r1", "r2"]


def bent(grid: OccupancyGrid, cells: int) -> OccupancyGrid:
    """One half of the map moved: another particle, with another corridor behind it, became the best."""
    half = grid.width // 2
    moved = grid.cells.copy()
    moved[:, half:] = np.roll(moved[:, half:], cells, axis=0)
    return replace(grid, cells=moved)


def merged_fleet(seed: int) -> Fleet:
    fleet = Fleet(seed)
    world = random_world(seed, 60.0, 0.5)
    for i, place in enumerate((SE2(-5, -4, 0.3), SE2(4, 2, -2.0), SE2(2, 8, 1.2))):
        explorer = Explorer.at(world, place, 0.7 * i)
        explorer.look(place, 12.0)
        fleet.add(NAMES[i], Liar.like(explorer))
    fleet.run_until(lambda: fleet.agrees(NAMES), 20.0)
    return fleet


def show(fleet: Fleet, cells: int) -> None:
    node = fleet.nodes["r1"]
    assert isinstance(node.explorer, Liar)
    node.explorer.change = lambda grid: bent(grid, cells)
    fleet.share_map(node)


@pytest.mark.parametrize("cells", [1, 2, 4, 8])
def test_a_robot_that_redraws_its_map_again_and_again_is_never_quarantined(cells: int) -> None:
    fleet = merged_fleet(4)
    for i in range(12):
        show(fleet, cells * (i % 2))
        fleet.run(6.0)
    assert not [note for node in fleet.nodes.values() for note in node.notes if note.event == "quarantined"]
    show(fleet, 0)
    fleet.run_until(lambda: fleet.agrees(NAMES), 60.0)
