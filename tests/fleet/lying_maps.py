"""Liars that change their map before they show it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from protocol.geometry import SE2
from protocol.grid import FREE, OCCUPIED, OccupancyGrid
from tests.fleet.explorer import Explorer
from tests.fleet.processes import Node
from tests.fleet.simulation import Fleet


class Attack:
    """A way to lie: `begin` is called once the fleet has merged, `every_second` after that."""

    is_detectable = True  # somebody honest can prove that it lies

    def begin(self, fleet: Fleet, node: Node) -> None:
        """Turn bad."""

    def every_second(self, fleet: Fleet, node: Node, age_s: float) -> None:
        """Go on being bad."""


class Liar(Explorer):
    """An explorer whose map is changed before it is shown."""

    change: Callable[[OccupancyGrid], OccupancyGrid] | None = None

    @property
    def grid(self) -> OccupancyGrid:
        honest = self._drawn()
        return honest if self.change is None else self.change(honest)

    @staticmethod
    def like(explorer: Explorer) -> Liar:
        return Liar(explorer.world, explorer.T_world_map, explorer.seen, explorer.T_world_robot)


class _MapAttack(Attack):
    def change(self, grid: OccupancyGrid, age_s: float) -> OccupancyGrid:
        raise NotImplementedError

    def begin(self, fleet: Fleet, node: Node) -> None:
        self.every_second(fleet, node, 0.0)

    def every_second(self, fleet: Fleet, node: Node, age_s: float) -> None:
        liar = node.explorer
        assert isinstance(liar, Liar)
        liar.change = lambda grid: self.change(grid, age_s)
        fleet.share_map(node)


class ShiftedMap(_MapAttack):
    """The whole map jumps by three metres."""

    is_detectable = False  # it is the same map at another place: what an honest filter draws when it changes its mind

    def change(self, grid: OccupancyGrid, age_s: float) -> OccupancyGrid:
        return replace(grid, origin=grid.origin @ SE2(3.0, -3.0, 0.0))


class MirroredMap(_MapAttack):
    """Left is right."""

    def change(self, grid: OccupancyGrid, age_s: float) -> OccupancyGrid:
        return replace(grid, cells=np.ascontiguousarray(grid.cells[:, ::-1]))


class AllFree(_MapAttack):
    """There are no walls anywhere."""

    def change(self, grid: OccupancyGrid, age_s: float) -> OccupancyGrid:
        return replace(grid, cells=np.full_like(grid.cells, FREE))


class AllOccupied(_MapAttack):
    """There are only walls."""

    def change(self, grid: OccupancyGrid, age_s: float) -> OccupancyGrid:
        return replace(grid, cells=np.full_like(grid.cells, OCCUPIED))


class DriftingMap(_MapAttack):
    """The map creeps away, ten centimetres a second."""

    is_detectable = False  # the same map, a little elsewhere

    def change(self, grid: OccupancyGrid, age_s: float) -> OccupancyGrid:
        steps = int(0.1 * age_s / grid.resolution_m)
        return replace(grid, cells=np.roll(grid.cells, steps, axis=1))


class InventedWalls(_MapAttack):
    """The true map with more and more walls through free space."""

    is_detectable = False  # each step is as small as honest maps differ

    def change(self, grid: OccupancyGrid, age_s: float) -> OccupancyGrid:
        cells = grid.cells.copy()
        rng = np.random.default_rng(5)
        free = np.argwhere(cells == FREE)
        chosen = free[rng.permutation(len(free))[: int(len(free) * min(0.01 * age_s, 0.4))]]
        cells[chosen[:, 0], chosen[:, 1]] = OCCUPIED
        return replace(grid, cells=cells)


class ErasedWalls(_MapAttack):
    """The true map with its walls vanishing one by one."""

    is_detectable = False

    def change(self, grid: OccupancyGrid, age_s: float) -> OccupancyGrid:
        cells = grid.cells.copy()
        walls = np.argwhere(cells == OCCUPIED)
        chosen = walls[np.random.default_rng(6).permutation(len(walls))[: int(len(walls) * min(0.03 * age_s, 1.0))]]
        cells[chosen[:, 0], chosen[:, 1]] = FREE
        return replace(grid, cells=cells)
