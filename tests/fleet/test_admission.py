"""Maps that take back what they said: an honest robot's is checked again and never punished, an invention is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from protocol.geometry import SE2
from protocol.grid import FREE, OCCUPIED, OccupancyGrid
from tests.fleet.attackers import Liar
from tests.fleet.explorer import Explorer, random_world
from tests.fleet.simulation import Fleet

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


def show(fleet: Fleet, change: Callable[[OccupancyGrid], OccupancyGrid]) -> None:
    node = fleet.nodes["r1"]
    assert isinstance(node.explorer, Liar)
    node.explorer.change = change
    fleet.share_map(node)


def events(fleet: Fleet, event: str) -> set[str]:
    return {name for name, node in fleet.nodes.items() for note in node.notes if note.event == event}


def with_invented_walls(grid: OccupancyGrid) -> OccupancyGrid:
    cells = grid.cells.copy()
    free = np.argwhere(cells == FREE)
    chosen = free[np.random.default_rng(1).permutation(len(free))[: len(free) // 30]]
    cells[chosen[:, 0], chosen[:, 1]] = OCCUPIED
    return replace(grid, cells=cells)


@pytest.mark.parametrize("cells", [1, 2, 4, 8])
def test_a_robot_that_redraws_its_map_again_and_again_is_never_quarantined(cells: int) -> None:
    fleet = merged_fleet(4)
    for i in range(10):
        show(fleet, lambda grid, by=cells * (i % 2): bent(grid, by))  # type: ignore[misc]
        fleet.run(6.0)
    assert not events(fleet, "quarantined")
    show(fleet, lambda grid: grid)
    fleet.run_until(lambda: fleet.agrees(NAMES), 60.0)


def test_walls_that_two_others_do_not_see_wait_and_the_agreed_map_stays() -> None:
    fleet = merged_fleet(4)
    before = fleet.digests()
    show(fleet, with_invented_walls)
    fleet.run(20.0)
    assert events(fleet, "held-back") == {"r0", "r2"}
    assert {fleet.digests()[name] for name in ("r0", "r2")} == {before["r0"]}
    assert not events(fleet, "quarantined")
    show(fleet, lambda grid: grid)
    fleet.run_until(lambda: "r0" in events(fleet, "taken-in-again") and fleet.agrees(NAMES), 10.0)


@pytest.mark.parametrize("value", [FREE, OCCUPIED])
def test_a_map_that_denies_itself_is_quarantined_at_once(value: int) -> None:
    fleet = merged_fleet(4)
    show(fleet, lambda grid: replace(grid, cells=np.full_like(grid.cells, value)))
    fleet.run_until(lambda: bool(events(fleet, "quarantined")), 5.0)
    fleet.run_until(lambda: fleet.agrees(["r0", "r2"]), 10.0)
