"""How far two maps contradict each other under a known transform: a few milliseconds, no features, no search."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from protocol.geometry import SE2
from protocol.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

_MAX_CELLS = 20_000  # of their map that are looked up; more does not change the third digit


@dataclass(frozen=True, slots=True)
class Agreement:
    """Cells known to both: as many say the same, as many contradict."""

    agree: int
    conflict: int

    @property
    def conflict_share(self) -> float:
        total = self.agree + self.conflict
        return self.conflict / total if total else 0.0


def agreement(ours: OccupancyGrid, theirs: OccupancyGrid, T_ours_theirs: SE2) -> Agreement:
    """Compare their known cells with ours; a wall one cell beside a wall is no contradiction."""
    known = np.argwhere(theirs.known())
    if len(known) > _MAX_CELLS:
        known = known[:: -(-len(known) // _MAX_CELLS)]
    if len(known) == 0:
        return Agreement(0, 0)
    said = theirs.cells[known[:, 0], known[:, 1]]
    points_m = T_ours_theirs.apply(theirs.points_of(known))
    held = ours.values_at(points_m)
    step = max(ours.resolution_m, theirs.resolution_m)
    near_wall = np.zeros(len(known), np.bool_)
    near_free = np.zeros(len(known), np.bool_)
    for dx, dy in ((step, 0.0), (-step, 0.0), (0.0, step), (0.0, -step)):
        beside = ours.values_at(points_m + np.array([dx, dy]))
        near_wall |= beside == OCCUPIED
        near_free |= beside == FREE
    both = held != UNKNOWN
    same = both & (held == said)
    soft = both & ~same & (((said == OCCUPIED) & near_wall) | ((said == FREE) & near_free))
    return Agreement(int(np.count_nonzero(same | soft)), int(np.count_nonzero(both & ~same & ~soft)))


def coarsened(grid: OccupancyGrid, resolution_m: float) -> OccupancyGrid:
    """The grid at about `resolution_m`: occupied where anything is, else free where anything is."""
    factor = max(1, round(resolution_m / grid.resolution_m))
    if factor == 1:
        return grid
    height, width = -(-grid.height // factor), -(-grid.width // factor)
    padded = np.full((height * factor, width * factor), UNKNOWN, np.int8)
    padded[: grid.height, : grid.width] = grid.cells
    return OccupancyGrid(padded.reshape(height, factor, width, factor).max(axis=(1, 3)), grid.resolution_m * factor, grid.origin)
