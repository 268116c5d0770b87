"""Pictures of maps: for the page, for files, for people.

Images flip here and nowhere else: row 0 of a grid is its lowest y, row 0 of a picture is its top.
"""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

from protocol.geometry import SE2
from protocol.grid import FREE, OCCUPIED, OccupancyGrid

Image = NDArray[np.uint8]  # (H, W, 3) BGR or (H, W, 4) BGRA

UNKNOWN_BGR = (205, 205, 205)  # the grey of map_server pictures
FREE_BGR = (254, 254, 254)
OCCUPIED_BGR = (30, 24, 20)
ROBOT_COLOURS_BGR = (
    (180, 90, 0),
    (30, 110, 220),
    (70, 150, 40),
    (150, 60, 150),
    (40, 40, 200),
    (150, 140, 0),
    (90, 90, 90),
    (60, 160, 220),
)
MAX_PIXELS = 4_000_000


def robot_colour(index: int) -> tuple[int, int, int]:
    return ROBOT_COLOURS_BGR[index % len(ROBOT_COLOURS_BGR)]


def grid_picture(grid: OccupancyGrid) -> Image:
    """(H, W, 3) one pixel a cell."""
    table = np.full((256, 3), UNKNOWN_BGR, np.uint8)
    table[FREE], table[OCCUPIED] = FREE_BGR, OCCUPIED_BGR
    return np.ascontiguousarray(table[grid.cells.astype(np.uint8)][::-1])


def grid_png(grid: OccupancyGrid) -> bytes:
    """One pixel a cell: black is unknown, grey 1 is free, grey 2 is occupied; the page gives them their colours."""
    table = np.zeros(256, np.uint8)
    table[FREE], table[OCCUPIED] = 128, 255
    ok, data = cv2.imencode(
        ".png", np.ascontiguousarray(table[grid.cells.astype(np.uint8)][::-1]), [cv2.IMWRITE_PNG_COMPRESSION, 4]
    )
    assert ok
    return bytes(data.tobytes())


def scale_for(grid: OccupancyGrid) -> int:
    """Pixels a cell, so that a small map is easy to look at and a big one still fits."""
    return int(np.clip(900 // max(grid.width, grid.height, 1), 1, 6))


def pixel_of(grid: OccupancyGrid, point_m: tuple[float, float], scale: int) -> tuple[int, int]:
    """(x, y) in the picture of a point of the map frame."""
    x_m, y_m = grid.origin.inverse().apply([point_m])[0]
    return round(x_m / grid.resolution_m * scale), round((grid.height - y_m / grid.resolution_m) * scale)


def map_picture(grid: OccupancyGrid, poses: Mapping[str, SE2], title: str = "") -> Image:
    """A map with its robots: a disc with a nose, and the name beside it.  Poses are in the map's frame."""
    scale = scale_for(grid)
    picture = cv2.resize(grid_picture(grid), None, fx=scale, fy=scale, interpolation=cv2.INTER_NEAREST)
    for index, (robot, pose) in enumerate(sorted(poses.items())):
        draw_robot(picture, grid, scale, pose, robot, robot_colour(index))
    if title:
        picture = with_title(picture, title)
    return np.asarray(picture, np.uint8)


def draw_robot(picture: Image, grid: OccupancyGrid, scale: int, pose: SE2, name: str, colour: tuple[int, int, int]) -> None:
    radius_m = 0.25
    x, y = pixel_of(grid, (pose.x_m, pose.y_m), scale)
    nose = pixel_of(grid, tuple(pose.apply([(2.2 * radius_m, 0.0)])[0]), scale)
    radius = max(4, round(radius_m / grid.resolution_m * scale))
    cv2.circle(picture, (x, y), radius + 1, (255, 255, 255), -1, cv2.LINE_AA)
    cv2.circle(picture, (x, y), radius, colour, -1, cv2.LINE_AA)
    cv2.line(picture, (x, y), nose, colour, max(2, radius // 3), cv2.LINE_AA)
    draw_text(picture, name, (x + radius + 4, y - radius), colour)


def draw_text(picture: Image, text: str, at: tuple[int, int], colour: tuple[int, int, int]) -> None:
    """Text with a light edge, kept inside the picture."""
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.5, 1)
    x = max(2, min(at[0], picture.shape[1] - width - 2))
    y = max(height + 2, min(at[1], picture.shape[0] - 4))
    cv2.putText(picture, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 4, cv2.LINE_AA)
    cv2.putText(picture, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, 0.5, colour, 1, cv2.LINE_AA)


def with_title(picture: Image, title: str) -> Image:
    """A strip of text above the picture."""
    width = max(picture.shape[1], 9 * len(title) + 16)
    canvas = np.full((picture.shape[0] + 28, width, 3), UNKNOWN_BGR, np.uint8)
    canvas[28:, : picture.shape[1]] = picture
    cv2.putText(canvas, title, (8, 19), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (30, 30, 30), 1, cv2.LINE_AA)
    return canvas


def png(picture: Image) -> bytes:
    ok, data = cv2.imencode(".png", picture)
    assert ok
    return bytes(data.tobytes())
