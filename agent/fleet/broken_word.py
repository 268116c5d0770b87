"""What a robot's newer cells take back of its earlier ones, and whether other robots still see it as it was.

An honest map grows, and its walls stay where they were; when its filter changes its mind they move, and then they agree with what
others see at another transform.  A lie takes back what others confirm.  On three recordings, each cut into three robots
that map with a particle filter, honest maps take back at most 0.33 % of the cells a neighbour confirms (0.8 % when a wall that
moves by one cell counts) from the first merge to the end.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from protocol.geometry import SE2
from protocol.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

_BESIDE = np.ones((3, 3), np.uint8)
_SAMPLES = 10_000  # cells of the earlier grid that tell how much of it a witness knows
_PATCH_CELLS, _PATCH_STEP, _SEARCH_CELLS = 24, 12, 24  # pieces of a map, coarse enough that a dozen fit into a corridor
_TURNS_DEG = (0.0, -5.0, 5.0, -10.0, 10.0, -15.0, 15.0)
_ALIKE = 0.6  # correlation of a piece with the place where it is found again


@dataclass(frozen=True, slots=True, eq=False)
class TakenBack:
    """Walls that appeared where free space was, and the other way round."""

    points_m: NDArray[np.float64]  # (N, 2) map frame of the robot
    was_wall: NDArray[np.bool_]  # (N,)
    is_near: NDArray[np.bool_]  # (N,) the wall moved by one cell only
    earlier: OccupancyGrid
    walls: int  # of either map, where both know something

    @property
    def share_of_walls(self) -> float:
        """How much of the drawing changed, near moves not counted."""
        return float(np.count_nonzero(~self.is_near)) / self.walls if self.walls else 0.0


@dataclass(frozen=True, slots=True)
class Testimony:
    """One witness: shares of the cells it knows of the earlier map that were taken back though it sees them as they were."""

    plain: float
    near: float  # the same, when walls that moved by one cell count as well


def taken_back(earlier: OccupancyGrid, newer: OccupancyGrid) -> TakenBack:
    """Compare two drawings of one robot in its own map frame."""
    old, new, window = _laid_together(earlier, newer)
    old_wall, new_wall = (old == OCCUPIED), (new == OCCUPIED)
    appeared, vanished = new_wall & (old == FREE), old_wall & (new == FREE)
    changed = np.argwhere(appeared | vanished)
    near = (appeared & _widened(old_wall)) | (vanished & _widened(new_wall))
    rows, cols = changed[:, 0], changed[:, 1]
    walls = int(np.count_nonzero((old_wall | new_wall) & (old != UNKNOWN) & (new != UNKNOWN)))
    return TakenBack(window.points_of(changed), vanished[rows, cols], near[rows, cols], earlier, walls)


def witnessed(change: TakenBack, witness: OccupancyGrid, T_witness_map: SE2) -> Testimony:
    """What one other map says of the change; how much it knows is the long part, and asked only of one that sees some of it."""
    points_m = T_witness_map.apply(change.points_m)
    there = witness.values_at(points_m)
    is_beside = witness.walls_around(points_m, witness.resolution_m)
    is_as_before = np.where(change.was_wall, is_beside, (there == FREE) & ~is_beside)
    is_exactly = np.where(change.was_wall, there == OCCUPIED, there == FREE)
    plain = int(np.count_nonzero(is_as_before & ~change.is_near))
    near = int(np.count_nonzero(is_exactly))
    common = _common_cells(change.earlier, witness, T_witness_map) if plain or near else 0
    return Testimony(plain / common, near / common) if common else Testimony(0.0, 0.0)


def _common_cells(earlier: OccupancyGrid, witness: OccupancyGrid, T_witness_map: SE2) -> int:
    """About how many cells both know."""
    step = max(1, math.isqrt(earlier.cells.size // _SAMPLES))
    known = step * np.argwhere(earlier.cells[::step, ::step] != UNKNOWN)
    return step**2 * int(np.count_nonzero(witness.values_at(T_witness_map.apply(earlier.points_of(known))) != UNKNOWN))


def grown(earlier: OccupancyGrid, newer: OccupancyGrid) -> OccupancyGrid:
    """The earlier cells, and the newer ones where nothing was known."""
    old, new, window = _laid_together(earlier, newer)
    return OccupancyGrid(np.where(old == UNKNOWN, new, old), window.resolution_m, window.origin)


def share_found_again(earlier: OccupancyGrid, newer: OccupancyGrid) -> float:
    """Share of the earlier map's pieces that the newer one still has somewhere near: a map that was redrawn moves in pieces."""
    best = 0.0
    for turn_rad in np.radians(_TURNS_DEG):
        turned = OccupancyGrid(earlier.cells, earlier.resolution_m, SE2(0.0, 0.0, float(turn_rad)) @ earlier.origin)
        best = max(best, _share_of_pieces_found(turned, newer))
        if best > 0.5:
            break
    return best


def _share_of_pieces_found(earlier: OccupancyGrid, newer: OccupancyGrid) -> float:
    old, new, _ = _laid_together(earlier, newer)
    factor = max(1, round(0.2 / earlier.resolution_m))
    was, there = (_shrunk((cells == OCCUPIED).astype(np.float32), factor) for cells in (old, new))
    reach, size = _SEARCH_CELLS, _PATCH_CELLS
    there = cv2.copyMakeBorder(there, reach, reach, reach, reach, cv2.BORDER_CONSTANT, value=0.0)
    height, width = was.shape
    found = []
    for row in range(0, max(1, height - size + 1), _PATCH_STEP):
        for col in range(0, max(1, width - size + 1), _PATCH_STEP):
            piece = was[row : row + size, col : col + size]
            if np.count_nonzero(piece) >= size:  # as much as one straight wall
                around = there[row : row + piece.shape[0] + 2 * reach, col : col + piece.shape[1] + 2 * reach]
                found.append(_best_correlation(piece, around) >= _ALIKE)
    return float(np.mean(found)) if found else 1.0


def _best_correlation(piece: NDArray[np.float32], around: NDArray[np.float32]) -> float:
    scores = cv2.matchTemplate(np.ascontiguousarray(around), np.ascontiguousarray(piece), cv2.TM_CCOEFF_NORMED)
    return float(np.nan_to_num(scores, nan=0.0, posinf=0.0, neginf=0.0).max())


def _shrunk(image: NDArray[np.float32], factor: int) -> NDArray[np.float32]:
    """A pixel for `factor` x `factor` cells: set where any is."""
    padded = np.pad(image, [(0, -side % factor) for side in image.shape])
    height, width = padded.shape[0] // factor, padded.shape[1] // factor
    return np.asarray(padded.reshape(height, factor, width, factor).max(axis=(1, 3)), np.float32)


def _laid_together(a: OccupancyGrid, b: OccupancyGrid) -> tuple[NDArray[np.int8], NDArray[np.int8], OccupancyGrid]:
    """The cells of both on the lattice of `b`, in a window that holds both, and the window (its cells are those of `b`)."""
    corners = b.cells_at(a.points_of([[0, 0], [0, a.width - 1], [a.height - 1, 0], [a.height - 1, a.width - 1]]))
    low = np.minimum(corners.min(axis=0), 0)
    height, width = np.maximum(corners.max(axis=0) + 1, [b.height, b.width]) - low
    shift = SE2(float(low[1]) * b.resolution_m, float(low[0]) * b.resolution_m, 0.0)
    window = OccupancyGrid(np.full((int(height), int(width)), UNKNOWN, np.int8), b.resolution_m, b.origin @ shift)
    window.cells[-low[0] : b.height - low[0], -low[1] : b.width - low[1]] = b.cells
    old = np.full_like(window.cells, UNKNOWN)
    row, col = corners[0] - low
    if _is_on_lattice(a, b):
        old[row : row + a.height, col : col + a.width] = a.cells
        return old, window.cells, window
    known = np.argwhere(a.known())
    at = window.cells_at(a.points_of(known))
    inside = ((at >= 0) & (at < old.shape)).all(axis=1)
    old[at[inside, 0], at[inside, 1]] = a.cells[known[inside, 0], known[inside, 1]]
    return old, window.cells, window


def _is_on_lattice(a: OccupancyGrid, b: OccupancyGrid) -> bool:
    """Whether the cells of both coincide, as they do while a map is drawn in one frame: then copying does, and is far quicker."""
    T_b_a = b.origin.inverse() @ a.origin
    off = np.array([T_b_a.x_m, T_b_a.y_m]) / b.resolution_m
    return a.resolution_m == b.resolution_m and abs(T_b_a.theta_rad) < 1e-9 and bool(np.abs(off - np.round(off)).max() < 1e-3)


def _widened(walls: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return np.asarray(cv2.dilate(walls.astype(np.uint8), _BESIDE) > 0)
