"""The features of the paper, to the letter: Hough lines, then Hough circles, then whatever connected curves remain (Table 1).

Each stage erases the cells it explained, so no cell is two features.  This is the baseline every later figure is measured
against, and the alphabet of `agent/merging/paper.py`; `extraction.py` makes the feature map that travels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from protocol.grid import OCCUPIED, UNKNOWN, OccupancyGrid

PAPER_COLUMNS = ("x_m", "y_m", "size_m", "orientation_rad")  # orientation in [0, pi): lines of the paper have no direction
FeatureRows = NDArray[np.float64]  # (N, 4)

MAX_WALL_CELLS = 120_000  # three times a 250 m campus at 10 cm
_LINE_THICKNESS_CELLS = 3  # cells either side of a Hough line that belong to it
_LINE_COVERED = 0.5  # share of a line that must still be there when its turn comes: else it is a duplicate
_CIRCLE_COVERED = 0.4


def _none() -> FeatureRows:
    return np.zeros((0, len(PAPER_COLUMNS)))


@dataclass(frozen=True, slots=True)
class PaperFeatureOptions:
    """Sizes in metres, so that maps of any resolution speak the same words."""

    min_length_m: float = 1.0  # shorter lines and curves are clutter, and vote for everything
    max_gap_m: float = 0.3  # a line may skip this much: doors ajar, missed beams
    min_radius_m: float = 0.25
    max_radius_m: float = 3.0
    max_per_kind: int = 120  # the longest; the vote is quadratic in this


@dataclass(frozen=True, slots=True, eq=False)
class PaperFeatures:
    """One row a feature: centre, size (length, radius or number of cells), orientation; map frame."""

    lines: FeatureRows = field(default_factory=_none)
    circles: FeatureRows = field(default_factory=_none)
    curves: FeatureRows = field(default_factory=_none)

    def __len__(self) -> int:
        return len(self.lines) + len(self.circles) + len(self.curves)


DEFAULTS = PaperFeatureOptions()


def paper_features(grid: OccupancyGrid, options: PaperFeatureOptions = DEFAULTS) -> PaperFeatures:
    """Section II of the paper: lines, circles and remaining curves of the occupied cells."""
    grid = _with_bounded_walls(grid)
    remaining = ((grid.cells == OCCUPIED) * 255).astype(np.uint8)
    if not remaining.any():
        return PaperFeatures()
    lines = _hough_lines(remaining, grid.resolution_m, options)
    circles = _hough_circles(remaining, grid.resolution_m, options)
    curves = _remaining_curves(remaining, grid.resolution_m, options)
    return PaperFeatures(*(_in_map_frame(rows, grid, options.max_per_kind) for rows in (lines, circles, curves)))


def _with_bounded_walls(grid: OccupancyGrid) -> OccupancyGrid:
    """The grid with cells twice as large, again and again, until the Hough transforms have a bounded number to look at."""
    while np.count_nonzero(grid.cells == OCCUPIED) > MAX_WALL_CELLS:
        cells = np.pad(grid.cells, [(0, side % 2) for side in grid.cells.shape], constant_values=UNKNOWN)
        pairs = np.maximum(cells[::2], cells[1::2])  # OCCUPIED is the largest value, so a wall stays a wall
        grid = OccupancyGrid(np.maximum(pairs[:, ::2], pairs[:, 1::2]), 2 * grid.resolution_m, grid.origin)
    return grid


def _hough_lines(remaining: NDArray[np.uint8], cell_m: float, options: PaperFeatureOptions) -> list[list[float]]:
    """Segments, longest first; each erases its cells from `remaining`."""
    found = cv2.HoughLinesP(
        remaining,
        rho=1,
        theta=math.pi / 180,
        threshold=max(8, int(0.5 / cell_m)),
        minLineLength=options.min_length_m / cell_m,
        maxLineGap=options.max_gap_m / cell_m,
    )
    lines = []
    for x0, y0, x1, y1 in _longest_first(found):
        length = math.hypot(x1 - x0, y1 - y0)
        if _erased(remaining, _drawn_line(remaining, x0, y0, x1, y1), at_least=_LINE_COVERED * length):
            lines.append([(x0 + x1 + 1) / 2, (y0 + y1 + 1) / 2, length, math.atan2(y1 - y0, x1 - x0) % math.pi])
    return lines


def _longest_first(found: NDArray[np.int32] | None) -> list[list[int]]:
    segments = [] if found is None else np.reshape(found, (-1, 4)).tolist()
    return sorted(segments, key=lambda s: (-math.hypot(s[2] - s[0], s[3] - s[1]), s))


def _hough_circles(remaining: NDArray[np.uint8], cell_m: float, options: PaperFeatureOptions) -> list[list[float]]:
    """Circles in the accumulator's order; each erases its cells from `remaining`."""
    if min(remaining.shape) < 3:
        return []
    found = cv2.HoughCircles(
        cv2.GaussianBlur(remaining, (3, 3), 0),
        cv2.HOUGH_GRADIENT,
        dp=1,
        minDist=0.6 / cell_m,
        param1=100,
        param2=14,
        minRadius=max(3, int(options.min_radius_m / cell_m)),
        maxRadius=max(4, int(options.max_radius_m / cell_m)),
    )
    circles = []
    for x, y, radius in [] if found is None else np.reshape(found, (-1, 3)).tolist():
        drawn = _drawn_circle(remaining, x, y, radius)
        if _erased(remaining, drawn, at_least=_CIRCLE_COVERED * math.tau * radius):
            circles.append([x + 0.5, y + 0.5, radius, 0.0])
    return circles


@dataclass(frozen=True, slots=True, eq=False)
class _Drawn:
    """A stroke on a small patch of the image, so that a stroke costs its own size and not the map's."""

    rows: slice
    cols: slice
    stroke: NDArray[np.bool_]


def _patch(image: NDArray[np.uint8], x0: float, y0: float, x1: float, y1: float) -> tuple[slice, slice]:
    margin = _LINE_THICKNESS_CELLS + 1
    rows = slice(max(0, int(min(y0, y1)) - margin), min(image.shape[0], int(max(y0, y1)) + margin + 1))
    cols = slice(max(0, int(min(x0, x1)) - margin), min(image.shape[1], int(max(x0, x1)) + margin + 1))
    return rows, cols


def _drawn_line(image: NDArray[np.uint8], x0: int, y0: int, x1: int, y1: int) -> _Drawn:
    rows, cols = _patch(image, x0, y0, x1, y1)
    canvas = np.zeros((rows.stop - rows.start, cols.stop - cols.start), np.uint8)
    start, end = (x0 - cols.start, y0 - rows.start), (x1 - cols.start, y1 - rows.start)
    cv2.line(canvas, start, end, 1, _LINE_THICKNESS_CELLS)
    return _Drawn(rows, cols, canvas > 0)


def _drawn_circle(image: NDArray[np.uint8], x: float, y: float, radius: float) -> _Drawn:
    rows, cols = _patch(image, x - radius, y - radius, x + radius, y + radius)
    canvas = np.zeros((max(0, rows.stop - rows.start), max(0, cols.stop - cols.start)), np.uint8)
    if canvas.size:
        cv2.circle(canvas, (round(x) - cols.start, round(y) - rows.start), round(radius), 1, 2)
    return _Drawn(rows, cols, canvas > 0)


def _erased(remaining: NDArray[np.uint8], drawn: _Drawn, at_least: float) -> bool:
    """Erase the stroke's cells when enough of them are still there."""
    patch = remaining[drawn.rows, drawn.cols]
    if np.count_nonzero(patch[drawn.stroke]) < at_least:
        return False
    patch[drawn.stroke] = 0
    return True


def _remaining_curves(remaining: NDArray[np.uint8], cell_m: float, options: PaperFeatureOptions) -> list[list[float]]:
    """Connected remains: centre of mass, size, and the orientation of the regression line through their cells."""
    _, labels = cv2.connectedComponents(cv2.dilate(remaining, np.ones((3, 3), np.uint8)), connectivity=8)
    rows, cols = np.nonzero(remaining)
    label = labels[rows, cols]
    x, y = cols + 0.5, rows + 0.5
    count = np.maximum(np.bincount(label), 1)
    mean_x, mean_y = np.bincount(label, x) / count, np.bincount(label, y) / count
    dx, dy = x - mean_x[label], y - mean_y[label]
    xx, yy, xy = np.bincount(label, dx * dx), np.bincount(label, dy * dy), np.bincount(label, dx * dy)
    orientation = (0.5 * np.arctan2(2 * xy, xx - yy)) % math.pi
    kept = np.bincount(label) * cell_m >= options.min_length_m
    curves: list[list[float]] = np.column_stack([mean_x, mean_y, count, orientation])[kept].tolist()
    return curves


def _in_map_frame(rows_px: list[list[float]], grid: OccupancyGrid, limit: int) -> FeatureRows:
    """From cells to metres of the map frame; the largest `limit` of them."""
    rows = np.array(sorted(rows_px, key=lambda row: -row[2])[:limit], np.float64).reshape(-1, len(PAPER_COLUMNS))
    rows[:, :2] = grid.origin.apply(rows[:, :2] * grid.resolution_m)
    rows[:, 2] *= grid.resolution_m
    rows[:, 3] = (rows[:, 3] + grid.origin.theta_rad) % math.pi
    return rows
