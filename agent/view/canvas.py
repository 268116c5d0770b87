"""A map's rectangle as a picture, and the pens for what is drawn on it: walls with their free side, arcs, curves, frames."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from agent.view.sheet import FAINT, FONT, UNKNOWN, Colour, Image
from protocol.features import FeatureMap, FeatureTable
from protocol.geometry import SE2
from protocol.grid import OccupancyGrid


@dataclass(slots=True, eq=False)
class Canvas:
    """A picture of a grid's rectangle, `scale` pixels a cell."""

    image: Image
    grid: OccupancyGrid
    scale: float

    @staticmethod
    def fitting(grid: OccupancyGrid, width: int, max_height: int) -> Canvas:
        scale = min(width / grid.width, max_height / grid.height)
        shape = (max(1, round(grid.height * scale)), max(1, round(grid.width * scale)), 3)
        return Canvas(np.full(shape, UNKNOWN, np.uint8), grid, scale)

    def paint(self, colours: Image) -> None:
        size = (self.image.shape[1], self.image.shape[0])
        flipped = np.ascontiguousarray(colours[::-1])
        if self.scale < 1:  # the darkest wins, or walls would fade when a big map shrinks
            side = math.ceil(1 / self.scale)
            flipped = np.asarray(cv2.erode(flipped, np.ones((side, side), np.uint8)), np.uint8)
        painted = cv2.resize(flipped, size, interpolation=cv2.INTER_AREA if self.scale < 1 else cv2.INTER_NEAREST)
        self.image = np.ascontiguousarray(painted, dtype=np.uint8)

    def pixels(self, points_m: NDArray[np.floating]) -> NDArray[np.int32]:
        """(N, 2) x, y in the picture, in sixteenths of a pixel."""
        local = self.grid.origin.inverse().apply(points_m) / self.grid.resolution_m * self.scale
        local[:, 1] = self.image.shape[0] - local[:, 1]
        return np.rint(np.clip(local, -1e4, 1e4) * 16).astype(np.int32)

    def stroke(self, points_m: NDArray[np.floating], colour: Colour, thickness: int, closed: bool = False) -> None:
        cv2.polylines(self.image, [self.pixels(points_m)], closed, colour, thickness, cv2.LINE_AA, 4)

    def wall_line(self, row: FeatureTable, colour: Colour, label: str = "", hairs: bool = True) -> None:
        """A line feature; its hairs point to the free side, its label stands there."""
        middle, angle, length = row[:2].astype(np.float64), float(row[2]), float(row[3])
        normal = np.array([math.cos(angle), math.sin(angle)])
        tangent = np.array([-normal[1], normal[0]])
        metre_px = self.scale / self.grid.resolution_m
        self.stroke(np.array([middle - tangent * length / 2, middle + tangent * length / 2]), colour, 2)
        if hairs:
            count = 2 + int(min(length * metre_px / 14, 200))
            steps = np.linspace(-0.5, 0.5, count)[1:-1] * length
            for foot in middle + steps[:, None] * tangent:
                self.stroke(np.array([foot, foot + normal * 6 / metre_px]), colour, 1)
        if label:
            self.label_at(label, middle + normal * 16 / metre_px, colour)

    def label_at(self, text: str, point_m: NDArray[np.floating], colour: Colour) -> None:
        """A number in a box, kept inside the picture."""
        x, y = (self.pixels(point_m[None])[0] // 16).tolist()
        (width, height), _ = cv2.getTextSize(text, FONT, 0.42, 1)
        x = min(max(x, width // 2 + 5), self.image.shape[1] - width // 2 - 5)
        y = min(max(y, height), self.image.shape[0] - height)
        top, bottom = (x - width // 2 - 4, y - height // 2 - 4), (x + width // 2 + 4, y + height // 2 + 4)
        cv2.rectangle(self.image, top, bottom, (255, 255, 255), -1)
        cv2.rectangle(self.image, top, bottom, colour, 1, cv2.LINE_AA)
        cv2.putText(self.image, text, (x - width // 2, y + height // 2), FONT, 0.42, colour, 1, cv2.LINE_AA)

    def rounds(self, features: FeatureMap, colour: Colour, matched: Mapping[str, Sequence[int]]) -> None:
        """Circles, arcs and curves; those without a partner are faint."""
        for kind, rows, draw in (
            ("circles", features.circles, self.circle),
            ("arcs", features.arcs, self.arc),
            ("curves", features.curves, self.curve),
        ):
            for index, row in enumerate(rows):
                is_matched = index in matched[kind]
                draw(row, colour if is_matched else FAINT, 2 if is_matched else 1)

    def circle(self, row: FeatureTable, colour: Colour, thickness: int, label: str = "") -> None:
        self._round(row[:2], float(row[2]), 0.0, math.tau, colour, thickness, label)

    def arc(self, row: FeatureTable, colour: Colour, thickness: int, label: str = "") -> None:
        self._round(row[:2], float(row[2]), float(row[3]), float(row[4]), colour, thickness, label)

    def _round(
        self,
        centre_m: FeatureTable,
        radius_m: float,
        from_rad: float,
        span_rad: float,
        colour: Colour,
        thickness: int,
        label: str,
    ) -> None:
        turns = np.linspace(from_rad, from_rad + span_rad, 49)
        self.stroke(centre_m + radius_m * np.column_stack([np.cos(turns), np.sin(turns)]), colour, thickness)
        if label:
            outward = from_rad + span_rad / 2
            away_m = radius_m + 14 * self.grid.resolution_m / self.scale
            self.label_at(label, centre_m + away_m * np.array([math.cos(outward), math.sin(outward)]), colour)

    def curve(self, row: FeatureTable, colour: Colour, thickness: int, label: str = "") -> None:
        """A diamond at the centre of mass, with its orientation."""
        radius = 5 * self.grid.resolution_m / self.scale
        corners = row[:2] + radius * np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])
        self.stroke(corners, colour, thickness, closed=True)
        along = np.array([math.cos(row[2]), math.sin(row[2])])
        self.stroke(np.array([row[:2], row[:2] + 2.4 * radius * along]), colour, thickness)
        if label:
            self.label_at(label, row[:2] + 3 * radius, colour)

    def frame_axes(self, T_frame_map: SE2, colour: Colour) -> None:
        """Where a map's own frame lies: its x axis long, its y axis short; left out when it is outside."""
        length = 34 * self.grid.resolution_m / self.scale
        points = T_frame_map.apply([(0, 0), (length, 0), (0, 0.6 * length)])
        px = self.pixels(points) // 16
        if ((px < 0) | (px >= self.image.shape[1::-1])).any():
            return
        for end in px[1:]:
            cv2.arrowedLine(self.image, px[0].tolist(), end.tolist(), colour, 2, cv2.LINE_AA, tipLength=0.25)
