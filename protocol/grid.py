"""The occupancy grid that robots draw, compare and send: `nav_msgs/OccupancyGrid`, trinary.

row ^            cell (row, col) covers x in [col, col + 1) * resolution, y in [row, row + 1) * resolution
    |            of the grid's own axes; `origin` is the pose of cell (0, 0)'s lower-left corner in the map
    +----> col   frame.  Images flip at the very edge, when drawn or saved.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from protocol.geometry import SE2

UNKNOWN = -1
FREE = 0
OCCUPIED = 100


@dataclass(frozen=True, slots=True, eq=False)
class OccupancyGrid:
    """Trinary cells and where they lie."""

    cells: NDArray[np.int8]  # (H, W) of UNKNOWN, FREE, OCCUPIED
    resolution_m: float  # side of a cell
    origin: SE2 = SE2(0.0, 0.0, 0.0)  # pose of cell (0, 0)'s lower-left corner in the map frame

    @staticmethod
    def empty(resolution_m: float) -> OccupancyGrid:
        """A map in which nothing is known yet: one unknown cell."""
        return OccupancyGrid(np.full((1, 1), UNKNOWN, np.int8), resolution_m)

    @property
    def height(self) -> int:
        return int(self.cells.shape[0])

    @property
    def width(self) -> int:
        return int(self.cells.shape[1])

    def known(self) -> NDArray[np.bool_]:
        """(H, W) True where a cell is free or occupied."""
        return np.not_equal(self.cells, UNKNOWN)

    def known_area_m2(self) -> float:
        return float(np.count_nonzero(self.known())) * self.resolution_m**2

    def points_of(self, cells_rc: ArrayLike) -> NDArray[np.float64]:
        """(N, 2) metres, map frame: the centres of (N, 2) cells given as (row, col)."""
        rc = np.asarray(cells_rc, dtype=np.float64).reshape(-1, 2)
        return self.origin.apply((rc[:, ::-1] + 0.5) * self.resolution_m)

    def cells_at(self, points_m: ArrayLike) -> NDArray[np.int64]:
        """(N, 2) (row, col) of the cells that hold (N, 2) map-frame points; may lie outside the grid."""
        local = self.origin.inverse().apply(np.asarray(points_m, dtype=np.float64).reshape(-1, 2))
        return np.floor(local[:, ::-1] / self.resolution_m).astype(np.int64)

    def values_at(self, points_m: ArrayLike) -> NDArray[np.int8]:
        """(N,) cell values under map-frame points; UNKNOWN outside the grid."""
        rc = self.cells_at(points_m)
        inside = (rc[:, 0] >= 0) & (rc[:, 1] >= 0) & (rc[:, 0] < self.height) & (rc[:, 1] < self.width)
        values = np.full(len(rc), UNKNOWN, np.int8)
        values[inside] = self.cells[rc[inside, 0], rc[inside, 1]]
        return values

    def walls_around(self, points_m: ArrayLike, step_m: float) -> NDArray[np.bool_]:
        """(N,) whether the cell under a map-frame point is a wall, or one of the eight that lie `step_m` from it."""
        step, size = max(1, round(step_m / self.resolution_m)), np.array(self.cells.shape)
        walls = np.pad(self.cells == OCCUPIED, 3 * step)  # so that every step from a point outside ends in here, and in no wall
        rows, cols = (np.clip(self.cells_at(points_m), -2 * step, size - 1 + 2 * step) + 3 * step).T
        at, steps = rows * walls.shape[1] + cols, (-step, 0, step)
        around = [walls.take(at + dr * walls.shape[1] + dc) for dr in steps for dc in steps]
        return np.asarray(np.logical_or.reduce(around))

    def cropped(self, margin_cells: int = 0) -> OccupancyGrid:
        """The known part only, with a margin of unknown cells; `empty` when nothing is known."""
        known = self.known()
        rows, cols = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
        if rows.size == 0:
            return replace(OccupancyGrid.empty(self.resolution_m), origin=self.origin)
        if margin_cells == 0 and (rows[0], cols[0], rows[-1] + 1, cols[-1] + 1) == (0, 0, *self.cells.shape):
            return self
        part = self.cells[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1]
        cells = np.pad(part, margin_cells, constant_values=UNKNOWN)
        corner = SE2((cols[0] - margin_cells) * self.resolution_m, (rows[0] - margin_cells) * self.resolution_m, 0.0)
        return OccupancyGrid(cells, self.resolution_m, self.origin @ corner)

    def content_hash(self) -> bytes:
        """16 bytes that differ when the cells, the resolution or the origin differ."""
        origin = np.array([self.resolution_m, self.origin.x_m, self.origin.y_m, self.origin.theta_rad, *self.cells.shape])
        digest = hashlib.sha256(origin.astype("<f8").tobytes())
        digest.update(np.ascontiguousarray(self.cells, dtype=np.int8).tobytes())
        return digest.digest()[:16]
