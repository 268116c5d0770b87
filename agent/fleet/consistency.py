"""How far two maps contradict each other under a known transform: a few milliseconds, no features, no search."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protocol.geometry import SE2
from protocol.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

_READ_BACK, _MOVED_WALLS = 0.5, 0.1  # share of the area at least, of the walls at most: the newest minutes may be lost
_MAX_CELLS = 20_000  # of their map that are looked up; more does not change the third digit


@dataclass(frozen=True, slots=True)
class Agreement:
    """Cells known to both: as many say the same, as many contradict; and the same of walls alone, which says far more."""

    agree: int
    conflict: int
    walls: int  # wall cells of either map where the other knows something
    wall_conflict: int  # of these, in free space of the other with no wall of it beside

    @property
    def conflict_share(self) -> float:
        total = self.agree + self.conflict
        return self.conflict / total if total else 0.0

    @property
    def wall_conflict_share(self) -> float:
        return self.wall_conflict / self.walls if self.walls else 0.0


def agreement(ours: OccupancyGrid, theirs: OccupancyGrid, T_ours_theirs: SE2) -> Agreement:
    """Compare two maps; a wall one cell beside a wall is no contradiction, in either direction."""
    known = _thinned(np.argwhere(theirs.known()))
    held = ours.values_at(T_ours_theirs.apply(theirs.points_of(known)))
    both = int(np.count_nonzero(held != UNKNOWN))
    step_m = max(ours.resolution_m, theirs.resolution_m)
    seen_a, against_a = _walls_against(theirs, ours, T_ours_theirs, step_m)
    seen_b, against_b = _walls_against(ours, theirs, T_ours_theirs.inverse(), step_m)
    conflict = min(against_a + against_b, both)
    return Agreement(both - conflict, conflict, seen_a + seen_b, against_a + against_b)


def is_same_drawing(earlier: OccupancyGrid, newer: OccupancyGrid) -> bool:
    """Whether a map that was begun anew is the earlier one, read back from a disk; one of another place starts small."""
    found = agreement(earlier, newer, SE2.identity())
    is_whole = newer.known_area_m2() >= _READ_BACK * earlier.known_area_m2()
    return is_whole and found.walls > 0 and found.wall_conflict_share <= _MOVED_WALLS


def _walls_against(walls_of: OccupancyGrid, free_of: OccupancyGrid, T: SE2, step_m: float) -> tuple[int, int]:
    """(walls of one map where the other knows something, those in its free space and away from its walls)."""
    points_m = T.apply(walls_of.points_of(_thinned(np.argwhere(walls_of.cells == OCCUPIED))))
    there = free_of.values_at(points_m)
    in_free = there == FREE
    beside = free_of.walls_around(points_m[in_free], step_m)
    return int(np.count_nonzero(there != UNKNOWN)), int(np.count_nonzero(in_free) - np.count_nonzero(beside))


def _thinned(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    return cells[:: max(1, -(-len(cells) // _MAX_CELLS))]
