"""Merging as a library function: two arrays in, one verdict out.

    from agent.merging import merge_arrays

    result = merge_arrays(map_a, map_b, 0.05)
    if result.accepted:
        T = result.T_ours_theirs            # x_m, y_m, theta_rad: points of b's frame to a's
        merged = fuse_arrays(map_a, map_b, 0.05, T)

A map is an (H, W) int8 array as in `nav_msgs/OccupancyGrid`: -1 unknown, 0 free, 100 occupied, row 0 the lowest y; its frame
has its origin at the lower-left corner of cell (0, 0), x along the columns, y along the rows.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from agent.features.snapshot import MapSnapshot
from agent.merging.errors import MapArrayError
from agent.merging.fusion import FusedMap, fuse
from agent.merging.matching import match_maps
from agent.merging.result import MatchOptions, MergeResult
from protocol.geometry import SE2
from protocol.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

OCCUPIED_FROM = 65  # nav2's thresholds for values between 0 and 100
FREE_UP_TO = 25
CANVAS_MARGIN_CELLS = 2


def merge_arrays(
    map_a: ArrayLike,
    map_b: ArrayLike,
    resolution_m: float,
    resolution_b_m: float | None = None,
    options: MatchOptions | None = None,
) -> MergeResult:
    """Find the transform that lays map b on map a, in metres and radians; `resolution_b_m` when b's cells are of another size."""
    ours = grid_from_array(map_a, resolution_m, "map a")
    theirs = grid_from_array(map_b, resolution_m if resolution_b_m is None else resolution_b_m, "map b")
    return match_maps(MapSnapshot.of(without_canvas(ours)), MapSnapshot.of(without_canvas(theirs)), options)


def fuse_arrays(
    map_a: ArrayLike, map_b: ArrayLike, resolution_m: float, T_a_b: SE2, resolution_b_m: float | None = None
) -> FusedMap:
    """Both maps in a's frame, conflicting cells unknown; `.grid.origin` says where cell (0, 0) lies in a's frame."""
    ours = grid_from_array(map_a, resolution_m, "map a")
    theirs = grid_from_array(map_b, resolution_m if resolution_b_m is None else resolution_b_m, "map b")
    return fuse([(ours, SE2.identity()), (theirs, T_a_b)])


def grid_from_array(cells: ArrayLike, resolution_m: float, name: str) -> OccupancyGrid:
    """A trinary grid whose frame is its own lower-left corner; refuses what is no map."""
    array = np.asarray(cells)
    if array.ndim != 2 or not np.issubdtype(array.dtype, np.integer):
        raise MapArrayError(f"{name}: {array.ndim} dimensions of {array.dtype}; give an (H, W) array of integers, -1 to 100")
    if not (math.isfinite(resolution_m) and resolution_m > 0):
        raise MapArrayError(f"{name}: a resolution of {resolution_m} m; it must be positive")
    if array.size and not (array.min() >= -1 and array.max() <= 100):
        raise MapArrayError(f"{name}: values from {array.min()} to {array.max()}; -1 is unknown, 0 free, 100 occupied")
    return OccupancyGrid(_trinary(array), resolution_m) if array.size else OccupancyGrid.empty(resolution_m)


def _trinary(array: NDArray[np.integer]) -> NDArray[np.int8]:
    cells = np.full(array.shape, UNKNOWN, np.int8)
    cells[(array >= 0) & (array <= FREE_UP_TO)] = FREE
    cells[array >= OCCUPIED_FROM] = OCCUPIED
    return cells


def without_canvas(grid: OccupancyGrid) -> OccupancyGrid:
    """The same map without the unknown around it when that is most of it: some save a building on 4000 x 4000 cells."""
    known = grid.cropped(CANVAS_MARGIN_CELLS)
    return known if 2 * known.cells.size < grid.cells.size else grid


def at_corner(grid: OccupancyGrid) -> OccupancyGrid:
    """The same cells in the frame of their own lower-left corner."""
    return replace(grid, origin=SE2.identity())
