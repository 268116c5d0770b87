"""A grid to its feature map: lines, then circles and arcs, then the curves that remain, each stage erasing what it explained.

    features = extract_features(grid)

This follows section II of the paper with better tools: signed total-least-squares lines instead of Hough lines, circles and arcs
with a span, curves at three sizes.  Everything carries its uncertainty, so a noisier map has vaguer features, not other ones.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from agent.features.curves import curve_table
from agent.features.lines import WallLines, wall_lines
from agent.features.round_walls import Arc, ArcsOfPieces, as_tables, find_arcs
from agent.features.wall_points import WallPoints, wall_points
from agent.features.working import WorkingGrid
from protocol.features import FeatureMap, FeatureTable
from protocol.geometry import SE2
from protocol.grid import OccupancyGrid

MIN_PIECE_M = 0.6  # less connected wall than this is a leg of a chair
LINE_WIDTH_M = 0.3  # wall this wide around a line is the line's: both surfaces, and their noise
CORNER_M = 0.2
MAX_CHORD_M = 2.5  # a shorter line may be a chord of something round: arcs get to see its cells too
MAX_TAKEN = 0.6  # a line more of which lies on arcs was one


def extract_features(grid: OccupancyGrid) -> FeatureMap:
    """All features of a grid, in its map frame."""
    working = WorkingGrid.of(grid)
    if not working.occupied.any():
        return FeatureMap()
    walls = wall_points(working)
    return feature_map(working, walls, wall_lines(walls, working.resolution_m), grid.origin, {})


def feature_map(
    working: WorkingGrid, walls: WallPoints, lines: WallLines, T_map_grid: SE2, known_arcs: ArcsOfPieces
) -> FeatureMap:
    """The same, from the wall points and lines that matching has made already, and arcs of an earlier state of the map."""
    if not len(walls):
        return FeatureMap()
    cells_m = (walls.cells_rc[:, ::-1].astype(np.float64) + 0.5) * working.resolution_m  # (N, 2) grid frame
    line_of = _line_of_points(working, walls, lines)
    lengths_m = np.append(lines.lengths_m, 0.0)  # the last entry is for line -1, none
    loose = np.flatnonzero(lengths_m[line_of] < MAX_CHORD_M)
    piece = _piece_numbers(walls.cells_rc[loose])
    sizeable = np.bincount(piece)[piece] * working.resolution_m >= MIN_PIECE_M
    loose, piece = loose[sizeable], piece[sizeable]
    arcs = find_arcs(cells_m[loose], piece, working.resolution_m, known_arcs)
    on_arc = np.zeros(len(walls), np.bool_)
    on_arc[loose] = _explained(arcs, cells_m[loose], working.resolution_m)
    kept = _straight_lines(lines, arcs, working.resolution_m)
    rest = loose[~on_arc[loose] & ~np.append(kept, False)[line_of[loose]]]
    circles, round_pieces = as_tables(arcs)
    curves = curve_table(cells_m[rest], walls.normals[rest].astype(np.float64), working.resolution_m)
    return FeatureMap(
        lines.table(T_map_grid)[kept & lines.is_distinct],
        _moved(circles, T_map_grid, turned=()),
        _moved(round_pieces, T_map_grid, turned=(3,)),
        _moved(curves, T_map_grid, turned=(2,)),
    )


def _line_of_points(working: WorkingGrid, walls: WallPoints, lines: WallLines) -> NDArray[np.int64]:
    """(N,) the longest line through each wall point's cell, -1 for none: the lines are painted, the short ones first.

    They are painted a little beyond their ends, where corners are too round for a line and too small for anything else.
    """
    canvas = np.full(working.occupied.shape, -1, np.int32)
    half_m = (lines.lengths_m / 2 + CORNER_M)[:, None]
    tangents = np.stack([-lines.normals[:, 1], lines.normals[:, 0]], axis=1) * half_m
    ends = np.stack([lines.middles_m - tangents, lines.middles_m + tangents], axis=1) / working.resolution_m - 0.5
    thickness = max(1, round(LINE_WIDTH_M / working.resolution_m))
    for i in range(len(lines) - 1, -1, -1):
        (x0, y0), (x1, y1) = np.rint(ends[i]).astype(int).tolist()
        cv2.line(canvas, (x0, y0), (x1, y1), i, thickness)
    return canvas[walls.cells_rc[:, 0], walls.cells_rc[:, 1]].astype(np.int64)


def _piece_numbers(cells_rc: NDArray[np.int32]) -> NDArray[np.int64]:
    """(N,) number of the connected piece of each cell; cells two apart still touch."""
    if not len(cells_rc):
        return np.zeros(0, np.int64)
    low = cells_rc.min(axis=0)
    shape = cells_rc.max(axis=0) - low + 3
    image = np.zeros(shape, np.uint8)
    row, col = (cells_rc - low + 1).T
    image[row, col] = 1
    _, labels = cv2.connectedComponents(cv2.dilate(image, np.ones((2, 2), np.uint8)), connectivity=8)
    return np.unique(labels[row, col], return_inverse=True)[1].astype(np.int64)


def _explained(arcs: list[Arc], points_m: NDArray[np.float64], resolution_m: float) -> NDArray[np.bool_]:
    explained = np.zeros(len(points_m), np.bool_)
    for arc in arcs:
        explained |= arc.explains(points_m, resolution_m)
    return explained


def _straight_lines(lines: WallLines, arcs: list[Arc], resolution_m: float) -> NDArray[np.bool_]:
    """(N,) lines that remain: one that runs along an arc was a chord of it, and is erased."""
    along = np.linspace(-0.45, 0.45, 10)[None, :, None] * lines.lengths_m[:, None, None]
    points = lines.middles_m[:, None] + along * np.stack([-lines.normals[:, 1], lines.normals[:, 0]], axis=1)[:, None]
    on_arc = _explained(arcs, points.reshape(-1, 2), resolution_m).reshape(-1, 10)
    straight: NDArray[np.bool_] = (on_arc.mean(axis=1) <= MAX_TAKEN) | (lines.lengths_m >= MAX_CHORD_M)
    return straight


def _moved(table: FeatureTable, T_map_grid: SE2, turned: tuple[int, ...]) -> FeatureTable:
    """From the grid frame to the map frame; `turned` are the columns that hold directions."""
    moved = table.copy()
    moved[:, :2] = T_map_grid.apply(table[:, :2])
    for column in turned:
        moved[:, column] = np.remainder(table[:, column] + T_map_grid.theta_rad + math.pi, math.tau) - math.pi
    return moved
