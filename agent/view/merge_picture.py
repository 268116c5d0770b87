"""Why two maps merged, or did not, in one picture: both maps with their features above, one laid on the other below.

Colours hold for both halves: blue is the first map, orange the second, green what they agree on, red where they conflict.
A line's hairs point to its free side; matched lines carry the same number in both maps.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from protocol.features import FeatureMap, FeatureTable
from protocol.geometry import SE2
from protocol.grid import FREE, OCCUPIED, OccupancyGrid

Image = NDArray[np.uint8]  # (H, W, 3) BGR
Colour = tuple[int, int, int]

PAPER: Colour = (250, 250, 250)
INK: Colour = (45, 40, 38)
FAINT: Colour = (150, 145, 140)
UNKNOWN: Colour = (226, 224, 222)
OURS: Colour = (178, 95, 12)  # blue
THEIRS: Colour = (18, 112, 222)  # orange
AGREE: Colour = (70, 125, 20)  # green
CONFLICT: Colour = (60, 30, 215)  # red
OURS_FREE: Colour = (252, 240, 226)
THEIRS_FREE: Colour = (224, 240, 255)
AGREE_FREE: Colour = (232, 248, 232)
WALL_GREY: Colour = (140, 136, 132)

WIDTH = 1600
GAP = 24
NUMBERED_LINES = 24
_FONT = cv2.FONT_HERSHEY_DUPLEX


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
    before = _side_by_side(_map_panel(ours, OURS, half), _map_panel(theirs, THEIRS, half))
    parts = [heading(verdict, figures), before]
    if overlay is not None:
        parts += [_legend(), _overlay_panel(overlay, ours, theirs)]
    gap = np.full((GAP, WIDTH, 3), PAPER, np.uint8)
    return np.vstack([piece for part in parts for piece in (gap, part)] + [gap])


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


def centred(image: Image, width: int, above: int = 0) -> Image:
    """In the middle of a strip of paper."""
    side = (width - image.shape[1]) // 2
    right = width - image.shape[1] - side
    padded: Image = cv2.copyMakeBorder(image, above, 0, side, right, cv2.BORDER_CONSTANT, value=PAPER)
    return padded


def _moved_line(row: FeatureTable, T: SE2) -> FeatureTable:
    moved = row.copy()
    moved[:2] = T.apply(row[None, :2])[0]
    moved[2] = row[2] + T.theta_rad
    return moved


def _shaded(grid: OccupancyGrid) -> Image:
    colours = np.full((*grid.cells.shape, 3), UNKNOWN, np.uint8)
    colours[grid.cells == FREE] = (255, 255, 255)
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
            x, y = self.pixels((middle + normal * 16 / metre_px)[None])[0] // 16
            self.label(label, int(x), int(y), colour)

    def label(self, text: str, x: int, y: int, colour: Colour) -> None:
        (width, height), _ = cv2.getTextSize(text, _FONT, 0.42, 1)
        x = min(max(x, width // 2 + 5), self.image.shape[1] - width // 2 - 5)
        y = min(max(y, height), self.image.shape[0] - height)
        top, bottom = (x - width // 2 - 4, y - height // 2 - 4), (x + width // 2 + 4, y + height // 2 + 4)
        cv2.rectangle(self.image, top, bottom, (255, 255, 255), -1)
        cv2.rectangle(self.image, top, bottom, colour, 1, cv2.LINE_AA)
        cv2.putText(self.image, text, (x - width // 2, y + height // 2), _FONT, 0.42, colour, 1, cv2.LINE_AA)

    def rounds(self, features: FeatureMap, colour: Colour, matched: Mapping[str, Sequence[int]]) -> None:
        """Circles, arcs and curves; those without a partner are faint."""
        for kind, rows, draw in (
            ("circles", features.circles, self._circle),
            ("arcs", features.arcs, self._arc),
            ("curves", features.curves, self._curve),
        ):
            for index, row in enumerate(rows):
                is_matched = index in matched[kind]
                draw(row, colour if is_matched else FAINT, 2 if is_matched else 1)

    def _circle(self, row: FeatureTable, colour: Colour, thickness: int) -> None:
        turns = np.linspace(0, math.tau, 48, endpoint=False)
        self.stroke(row[:2] + row[2] * np.column_stack([np.cos(turns), np.sin(turns)]), colour, thickness, closed=True)

    def _arc(self, row: FeatureTable, colour: Colour, thickness: int) -> None:
        turns = np.linspace(row[3], row[3] + row[4], 32)
        self.stroke(row[:2] + row[2] * np.column_stack([np.cos(turns), np.sin(turns)]), colour, thickness)

    def _curve(self, row: FeatureTable, colour: Colour, thickness: int) -> None:
        """A diamond at the centre of mass, with its orientation."""
        radius = 5 * self.grid.resolution_m / self.scale
        corners = row[:2] + radius * np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])
        self.stroke(corners, colour, thickness, closed=True)
        tip = row[:2] + 2.4 * radius * np.array([math.cos(row[2]), math.sin(row[2])])
        self.stroke(np.array([row[:2], tip]), colour, thickness)

    def frame_axes(self, T_frame_map: SE2, colour: Colour) -> None:
        """Where a map's own frame lies: its x axis long, its y axis short; left out when it is outside."""
        length = 34 * self.grid.resolution_m / self.scale
        points = T_frame_map.apply([(0, 0), (length, 0), (0, 0.6 * length)])
        px = self.pixels(points) // 16
        if ((px < 0) | (px >= self.image.shape[1::-1])).any():
            return
        for end in px[1:]:
            cv2.arrowedLine(self.image, px[0].tolist(), end.tolist(), colour, 2, cv2.LINE_AA, tipLength=0.25)


def _side_by_side(left: Image, right: Image) -> Image:
    height = max(left.shape[0], right.shape[0])
    sheet = np.full((height, WIDTH, 3), PAPER, np.uint8)
    sheet[: left.shape[0], GAP : GAP + left.shape[1]] = left
    start = WIDTH - GAP - right.shape[1]
    sheet[: right.shape[0], start : start + right.shape[1]] = right
    return sheet


def _titled(image: Image, name: str, counts: str, colour: Colour, width: int) -> Image:
    strip = np.full((44, width, 3), PAPER, np.uint8)
    cv2.rectangle(strip, (0, 8), (16, 24), colour, -1)
    write(strip, name, 26, 22, 0.62, INK)
    write(strip, counts, 26, 40, 0.42, FAINT)
    return np.vstack([strip, centred(image, width, above=6)])


def heading(verdict: str, figures: Sequence[str]) -> Image:
    """The sentence on top, and the numbers below it."""
    strip = np.full((62, WIDTH, 3), PAPER, np.uint8)
    write(strip, verdict, GAP, 26, 0.9, INK)
    write(strip, "   ".join(figures), GAP, 54, 0.5, INK)
    return strip


def _legend() -> Image:
    strip = np.full((26, WIDTH, 3), PAPER, np.uint8)
    x = GAP
    for wall, free, text in (
        (OURS, OURS_FREE, "first map only"),
        (THEIRS, THEIRS_FREE, "second map only"),
        (AGREE, AGREE_FREE, "both agree"),
        (CONFLICT, CONFLICT, "conflict: unknown in the merged map"),
        (UNKNOWN, UNKNOWN, "unknown to both"),
    ):
        cv2.rectangle(strip, (x, 5), (x + 17, 21), wall, -1)
        cv2.rectangle(strip, (x + 18, 5), (x + 35, 21), free, -1)
        cv2.rectangle(strip, (x, 5), (x + 35, 21), FAINT, 1)
        write(strip, text, x + 44, 18, 0.48, INK)
        x += 44 + cv2.getTextSize(text, _FONT, 0.48, 1)[0][0] + 30
    return strip


def write(image: Image, text: str, x: int, y: int, size: float, colour: Colour) -> None:
    """A line of text that begins at x on the line y."""
    cv2.putText(image, text, (x, y), _FONT, size, colour, 1, cv2.LINE_AA)
