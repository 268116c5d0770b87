"""A map with its features drawn over it and numbered as in the table: the paper's Figure 1.

Blue lines with hairs to their free side, green circles and arcs, orange curves: a diamond at the centre of mass, and where it
points.
"""

from __future__ import annotations

import cv2
import numpy as np

from agent.view.canvas import Canvas
from agent.view.render import grid_picture
from agent.view.sheet import BLUE, GAP, GREEN, ORANGE, WIDTH, Image, centred, legend, stacked
from protocol.features import FeatureMap
from protocol.grid import OccupancyGrid

LEGEND = (((BLUE,), "line"), ((GREEN,), "circle or arc"), ((ORANGE,), "curve: its centre of mass, and its orientation"))
HOW_TO_READ = "hairs point to a line's free side; numbers are those of the table"
MAX_HEIGHT_PX = 1600
NUMBERED = 40  # more numbers than this hide the map


def features_picture(grid: OccupancyGrid, features: FeatureMap) -> Image:
    """The map in pale grey, its features in colour; row numbers are those of the tables."""
    canvas = Canvas.fitting(grid, WIDTH - 2 * GAP, MAX_HEIGHT_PX)
    canvas.paint(_pale(grid))
    for number, row in enumerate(features.lines, 1):
        canvas.wall_line(row, BLUE, _numbered(number, ""))
    for number, row in enumerate(features.circles, 1):
        canvas.circle(row, GREEN, 2, _numbered(number, "o"))
    for number, row in enumerate(features.arcs, 1):
        canvas.arc(row, GREEN, 2, _numbered(number, "a"))
    for number, row in enumerate(features.curves, 1):
        canvas.curve(row, ORANGE, 2, _numbered(number, "c"))
    return stacked([legend(LEGEND, HOW_TO_READ), centred(canvas.image, WIDTH)])


def _numbered(number: int, kind: str) -> str:
    return f"{kind}{number}" if number <= NUMBERED else ""


def _pale(grid: OccupancyGrid) -> Image:
    plain = grid_picture(grid)[::-1]
    return np.asarray(cv2.addWeighted(plain, 0.45, np.full_like(plain, 255), 0.55, 0), np.uint8)
