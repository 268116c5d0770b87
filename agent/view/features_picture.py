"""A map with its features drawn over it and numbered as in the table: the paper's Figure 1.

Blue lines with hairs to their free side, green circles and arcs, orange curves: a diamond at the centre of mass, and the
regression line through it.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from agent.view.render import Image, grid_picture
from protocol.features import FeatureMap
from protocol.grid import OccupancyGrid

Colour = tuple[int, int, int]

LINE: Colour = (178, 95, 12)
ROUND: Colour = (70, 125, 20)
CURVE: Colour = (18, 112, 222)
LONGEST_SIDE_PX = 1600
MAX_SCALE = 8.0
FRACTION_BITS = 4  # cv2 draws in sixteenths of a pixel
HAIR_EVERY_PX, HAIR_PX = 14, 6
NUMBERED = 40  # more numbers than this hide the map
_FONT = cv2.FONT_HERSHEY_SIMPLEX


def features_picture(grid: OccupancyGrid, features: FeatureMap) -> Image:
    """The map in pale grey, its features in colour; row numbers are those of the tables."""
    scale = min(MAX_SCALE, LONGEST_SIDE_PX / max(grid.width, grid.height))
    sheet = _Sheet(grid, scale)
    for number, row in enumerate(features.lines.astype(float), 1):
        sheet.line(row, number)
    for number, (x, y, radius, *_) in enumerate(features.circles.astype(float).tolist(), 1):
        sheet.round(x, y, radius, 0.0, math.tau, f"o{number}")
    for number, (x, y, radius, start, span, *_) in enumerate(features.arcs.astype(float).tolist(), 1):
        sheet.round(x, y, radius, start, span, f"a{number}")
    for number, row in enumerate(features.curves.astype(float), 1):
        sheet.curve(row, number)
    return sheet.image


class _Sheet:
    """The picture, and map-frame points on it."""

    def __init__(self, grid: OccupancyGrid, scale: float) -> None:
        size = (max(1, round(grid.width * scale)), max(1, round(grid.height * scale)))
        how = cv2.INTER_NEAREST if scale >= 1 else cv2.INTER_AREA
        plain = cv2.resize(grid_picture(grid), size, interpolation=how)
        self.image: Image = cv2.addWeighted(plain, 0.45, np.full_like(plain, 255), 0.55, 0).astype(np.uint8)
        self._grid, self._scale = grid, scale
        self.pixel_m = grid.resolution_m / scale

    def line(self, row: NDArray[np.float64], number: int) -> None:
        middle, normal = row[:2], np.array([math.cos(row[2]), math.sin(row[2])])
        half = np.array([-normal[1], normal[0]]) * row[3] / 2
        self._stroke(np.array([middle - half, middle + half]), LINE, 2)
        for at in np.linspace(-1, 1, 2 + int(row[3] / (HAIR_EVERY_PX * self.pixel_m)))[1:-1]:
            foot = middle + at * half
            self._stroke(np.array([foot, foot + normal * HAIR_PX * self.pixel_m]), LINE, 1)
        if number <= NUMBERED:
            self._text(str(number), middle + normal * 2.4 * HAIR_PX * self.pixel_m, LINE)

    def round(self, x_m: float, y_m: float, radius_m: float, start_rad: float, span_rad: float, label: str) -> None:
        turns = np.linspace(start_rad, start_rad + span_rad, 49)
        self._stroke(np.array([x_m, y_m]) + radius_m * np.column_stack([np.cos(turns), np.sin(turns)]), ROUND, 2)
        self._text(label, np.array([x_m, y_m]), ROUND)

    def curve(self, row: NDArray[np.float64], number: int) -> None:
        middle, along = row[:2], np.array([math.cos(row[2]), math.sin(row[2])])
        corners = middle + 5 * self.pixel_m * np.array([(1, 0), (0, 1), (-1, 0), (0, -1), (1, 0)])
        self._stroke(corners, CURVE, 2)
        self._stroke(np.array([middle - along * row[3] / 4, middle + along * row[3] / 4]), CURVE, 1)
        if number <= NUMBERED:
            self._text(f"c{number}", middle + 14 * self.pixel_m, CURVE)

    def _pixels(self, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
        px: NDArray[np.float64] = self._grid.origin.inverse().apply(points_m) / self.pixel_m
        px[:, 1] = self.image.shape[0] - px[:, 1]
        return px

    def _stroke(self, points_m: NDArray[np.float64], colour: Colour, thickness: int) -> None:
        px = np.rint(np.clip(self._pixels(points_m), -1e4, 1e4) * 2**FRACTION_BITS).astype(np.int32)
        cv2.polylines(self.image, [px], False, colour, thickness, cv2.LINE_AA, FRACTION_BITS)

    def _text(self, text: str, point_m: NDArray[np.float64], colour: Colour) -> None:
        x, y = np.rint(np.clip(self._pixels(point_m[None])[0], -1e4, 1e4)).astype(int).tolist()
        (width, height), _ = cv2.getTextSize(text, _FONT, 0.42, 1)
        at = (x - width // 2, y + height // 2)
        cv2.putText(self.image, text, at, _FONT, 0.42, (255, 255, 255), 4, cv2.LINE_AA)
        cv2.putText(self.image, text, at, _FONT, 0.42, colour, 1, cv2.LINE_AA)
