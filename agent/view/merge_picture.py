"""Why two maps merged, or did not, in one picture: both maps with their features above, one laid on the other below.

Colours hold for both halves: blue is the first map, orange the second, green what they agree on, red where they conflict.
A line's hairs point to its free side; matched lines carry the same number in both maps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from agent.view.canvas import Canvas
from agent.view.sheet import (
    BLUE,
    FAINT,
    GAP,
    GREEN,
    INK,
    KNOWN_FREE,
    ORANGE,
    PAPER,
    RED,
    UNKNOWN,
    WIDTH,
    Colour,
    Image,
    centred,
    heading,
    in_a_row,
    legend,
    stacked,
    write,
)
from protocol.features import FeatureMap, FeatureTable
from protocol.geometry import SE2
from protocol.grid import FREE, OCCUPIED, OccupancyGrid

OURS, THEIRS, AGREE, CONFLICT = BLUE, ORANGE, GREEN, RED
OURS_FREE: Colour = (252, 240, 226)
THEIRS_FREE: Colour = (224, 240, 255)
AGREE_FREE: Colour = (232, 248, 232)
WALL_GREY: Colour = (140, 136, 132)
LEGEND = (
    ((OURS, OURS_FREE), "first map only"),
    ((THEIRS, THEIRS_FREE), "second map only"),
    ((AGREE, AGREE_FREE), "both agree"),
    ((CONFLICT,), "conflict: unknown in the merged map"),
    ((UNKNOWN,), "unknown to both"),
)
HOW_TO_READ = "hairs point to a line's free side, numbers pair matched lines"
NUMBERED_LINES = 24


@dataclass(frozen=True, slots=True, eq=False)
class MapToDraw:
    """One of the two maps: its name, its cells, its features, and the rows of those that found a partner."""

    name: str
    grid: OccupancyGrid
    features: FeatureMap
    matched: Mapping[str, Sequence[int]]  # kind ("lines", ...) -> row numbers, in the order of their partners


@dataclass(frozen=True, slots=True, eq=False)
class Overlay:
    """Both maps on one lattice: `frame.cells` is the fused result, and ours and theirs are the cells each contributes."""

    frame: OccupancyGrid
    ours: NDArray[np.int8]  # (H, W)
    theirs: NDArray[np.int8]  # (H, W)
    conflicts: NDArray[np.bool_]  # (H, W)
    T_frame_ours: SE2
    T_frame_theirs: SE2


def merge_picture(ours: MapToDraw, theirs: MapToDraw, overlay: Overlay | None, verdict: str, figures: Sequence[str]) -> Image:
    """The whole sheet; without a transform (`overlay` None) only the two maps."""
    half = (WIDTH - 3 * GAP) // 2
    before = in_a_row([_map_panel(ours, OURS, half), _map_panel(theirs, THEIRS, half)])
    parts = [heading(verdict, figures), before]
    if overlay is not None:
        parts += [legend(LEGEND, HOW_TO_READ), _overlay_panel(overlay, ours, theirs)]
    return stacked(parts)


def _map_panel(drawn: MapToDraw, colour: Colour, width: int) -> Image:
    canvas = Canvas.fitting(drawn.grid, width, max_height=620)
    canvas.paint(_shaded(drawn.grid))
    for index, row in enumerate(drawn.features.lines):
        if index not in drawn.matched["lines"]:
            canvas.wall_line(row, FAINT)
    canvas.rounds(drawn.features, colour, drawn.matched)
    for number, index in enumerate(drawn.matched["lines"], start=1):
        canvas.wall_line(drawn.features.lines[index], colour, str(number) if number <= NUMBERED_LINES else "")
    counts = ", ".join(_counted(len(getattr(drawn.features, kind)), kind) for kind in ("lines", "circles", "arcs", "curves"))
    return _titled(canvas.image, drawn.name, counts, colour, width)


def _counted(n: int, plural: str) -> str:
    return f"{n} {plural if n != 1 else plural[:-1]}"


def _overlay_panel(overlay: Overlay, ours: MapToDraw, theirs: MapToDraw) -> Image:
    canvas = Canvas.fitting(overlay.frame, WIDTH - 2 * GAP, max_height=1100)
    canvas.paint(_blended(overlay))
    for number, index in enumerate(ours.matched["lines"], start=1):
        label = str(number) if number <= NUMBERED_LINES else ""
        canvas.wall_line(_moved_line(ours.features.lines[index], overlay.T_frame_ours), AGREE, label, hairs=False)
    canvas.frame_axes(overlay.T_frame_ours, OURS)
    canvas.frame_axes(overlay.T_frame_theirs, THEIRS)
    return centred(canvas.image, WIDTH)


def _moved_line(row: FeatureTable, T: SE2) -> FeatureTable:
    moved = row.copy()
    moved[:2] = T.apply(row[None, :2])[0]
    moved[2] = row[2] + T.theta_rad
    return moved


def _shaded(grid: OccupancyGrid) -> Image:
    colours = np.full((*grid.cells.shape, 3), UNKNOWN, np.uint8)
    colours[grid.cells == FREE] = KNOWN_FREE
    colours[grid.cells == OCCUPIED] = WALL_GREY
    return colours


def _blended(overlay: Overlay) -> Image:
    """(H, W, 3) one pixel a cell: who knows what, and where they disagree."""
    a_free, b_free = overlay.ours == FREE, overlay.theirs == FREE
    a_wall, b_wall = overlay.ours == OCCUPIED, overlay.theirs == OCCUPIED
    near_a, near_b = _widened(a_wall), _widened(b_wall)
    colours = np.full((*a_free.shape, 3), UNKNOWN, np.uint8)
    colours[a_free] = OURS_FREE
    colours[b_free] = THEIRS_FREE
    colours[a_free & b_free] = AGREE_FREE
    colours[a_wall] = OURS
    colours[b_wall] = THEIRS
    colours[(a_wall & near_b) | (b_wall & near_a)] = AGREE
    colours[overlay.conflicts] = CONFLICT
    return colours


def _widened(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    widened: NDArray[np.bool_] = np.greater(cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)), 0)
    return widened


def _titled(image: Image, name: str, counts: str, colour: Colour, width: int) -> Image:
    strip = np.full((44, width, 3), PAPER, np.uint8)
    cv2.rectangle(strip, (0, 8), (16, 24), colour, -1)
    write(strip, name, 26, 22, 0.62, INK)
    write(strip, counts, 26, 40, 0.42, FAINT)
    return np.vstack([strip, centred(image, width, above=6)])
