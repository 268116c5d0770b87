"""Stretches of a robot's own path as small maps: what one compares when a path comes back to where it was.

A map that drifted is wrong as a whole and right in every stretch of some metres, so a loop is found between two stretches.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from agent.mapping.redrawing import Drawing, draw, new_grid
from agent.mapping.scan_matching import Poses
from protocol.geometry import SE2
from protocol.grid import OccupancyGrid

LOCAL_M = 12.0  # of path: long enough to be told from its neighbours, short enough not to be bent itself
FEWEST, MOST = 16, 60  # keyframes of a stretch, whatever its length
CELL_M = 0.1
NEAR_M = 0.15  # a point this near to an old one says that the stretches lie right ...
OFF_M = 0.8  # ... and farther, but not as far as this, that they do not
FEWEST_POINTS = 150  # in sight of the old ones, or the two say nothing about one another
POINTS_A_SCAN = 60
RANGE_M = 15.0  # far points turn with the heading of one scan


def way_m(line: Poses) -> NDArray[np.float64]:
    """(K,) metres driven until each keyframe."""
    steps = np.hypot(*np.diff(line[:, :2], axis=0).T)
    return np.concatenate([[0.0], np.cumsum(steps)])


def recent(way: NDArray[np.float64]) -> range:
    """The keyframes of the last metres."""
    end = len(way)
    start = int(np.searchsorted(way, way[-1] - LOCAL_M))
    return range(max(min(start, end - FEWEST), end - MOST, 0), end)


def around(keyframe: int, way: NDArray[np.float64], first: int, end: int) -> range:
    """The keyframes within as many metres before and after one, of [first, end)."""
    low = int(np.searchsorted(way, way[keyframe] - LOCAL_M))
    high = int(np.searchsorted(way, way[keyframe] + LOCAL_M))
    low, high = min(low, keyframe - FEWEST // 2), max(high, keyframe + FEWEST // 2)
    return range(max(low, keyframe - MOST, first), min(high, keyframe + MOST, end))


def grid_of(drawing: Drawing, keyframes: range, line: Poses) -> OccupancyGrid:
    """A stretch alone, drawn in the map frame."""
    grid = new_grid(drawing.options)
    for k in keyframes:
        if (scan := drawing.scans.get(k)) is not None:
            draw(grid, drawing.options, scan, line[k])
    return grid.trinary()


def points_of(drawing: Drawing, keyframes: range, line: Poses) -> NDArray[np.float64]:
    """(N, 2) some of what a stretch saw, map frame."""
    points = [np.empty((0, 2))]
    for k in keyframes:
        if (scan := drawing.scans.get(k)) is None:
            continue
        hits = scan.points_m[scan.is_hit]
        hits = hits[np.hypot(hits[:, 0], hits[:, 1]) < RANGE_M]
        points.append(SE2(*map(float, line[k])).apply(hits[:: len(hits) // POINTS_A_SCAN + 1]))
    return np.concatenate(points)


def agreement(old_m: NDArray[np.float64], new_m: NDArray[np.float64]) -> float:
    """Share of the new points in sight of old ones that lie on them; nan where too few are."""
    if len(old_m) == 0 or len(new_m) == 0:
        return float("nan")
    low = old_m.min(axis=0) - OFF_M
    cells = np.floor((old_m - low) / CELL_M).astype(np.int64)
    size = cells.max(axis=0) + int(OFF_M / CELL_M) + 1
    empty = np.ones((size[1], size[0]), np.uint8)
    empty[cells[:, 1], cells[:, 0]] = 0
    distance_m = cv2.distanceTransform(empty, cv2.DIST_L2, 3) * CELL_M
    at = np.floor((new_m - low) / CELL_M).astype(np.int64)
    at = at[(at >= 0).all(axis=1) & (at < size).all(axis=1)]
    seen = distance_m[at[:, 1], at[:, 0]]
    near, off = np.count_nonzero(seen <= NEAR_M), np.count_nonzero((seen > NEAR_M) & (seen < OFF_M))
    return near / (near + off) if near + off >= FEWEST_POINTS else float("nan")
