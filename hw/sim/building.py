"""What buildings are made of: outlines, walls with doors, and furniture that leaves every place reachable."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hw.sim.places import Clearance
from hw.sim.world import ROBOT_RADIUS_M, World, circle_points, polygon, sample_walls

WALL_M = 0.12  # thickness of an inner wall
DOOR_M = (0.95, 1.2)  # a robot of 0.4 m passes with room to spare
PASSAGE_M = ROBOT_RADIUS_M + 0.12  # half the width that furniture leaves free
Shape = NDArray[np.float64]  # (N, 4) segments
Rect = tuple[float, float, float, float]  # x0, y0, x1, y1


def furnished(
    rng: np.random.Generator, bare: World, rooms: list[Rect], pieces_per_m2: float, wanted: Sequence[Shape] = ()
) -> World | None:
    """Add furniture, keeping only what leaves every place reachable; None when the bare rooms are not connected."""
    shapes, clearance = [bare.segments], Clearance.of(bare)
    if not clearance.is_one_place(PASSAGE_M):
        return None
    pieces = list(wanted)
    for room in rooms:
        area_m2 = (room[2] - room[0]) * (room[3] - room[1])
        pieces += [_piece(rng, room) for _ in range(max(1, round(area_m2 * pieces_per_m2)))]
    for piece in pieces:
        with_piece = clearance.with_walls(sample_walls(piece, clearance.resolution_m / 2))
        if with_piece.is_one_place(PASSAGE_M):
            shapes.append(piece)
            clearance = with_piece
    return World.of(bare.name, shapes)


def _piece(rng: np.random.Generator, room: Rect) -> Shape:
    """A cupboard or desk against a wall, a table at an angle, or something round."""
    x0, y0, x1, y1 = room
    kind = rng.random()
    x, y = rng.uniform(x0 + 0.9, x1 - 0.9), rng.uniform(y0 + 0.9, y1 - 0.9)
    if kind < 0.22:
        return polygon(circle_points(x, y, float(rng.uniform(0.15, 0.55))))
    if kind < 0.42:
        return turned_box(rng, x, y, rng.uniform(0.6, 1.6), rng.uniform(0.4, 0.8))
    length, depth = rng.uniform(0.6, 2.0), rng.uniform(0.3, 0.8)
    side = int(rng.integers(4))
    if side == 0:
        return polygon([(x, y0), (x + length, y0), (x + length, y0 + depth), (x, y0 + depth)])
    if side == 1:
        return polygon([(x, y1 - depth), (x + length, y1 - depth), (x + length, y1), (x, y1)])
    if side == 2:
        return polygon([(x0, y), (x0 + depth, y), (x0 + depth, y + length), (x0, y + length)])
    return polygon([(x1 - depth, y), (x1, y), (x1, y + length), (x1 - depth, y + length)])


def chipped_outline(rng: np.random.Generator, width: float, height: float) -> list[tuple[float, float]]:
    """A rectangle with its corners cut at different slants."""
    a, b, c, d = rng.uniform(0.5, 1.6, 4)
    e, f, g, h = rng.uniform(0.5, 1.6, 4)
    return [(a, 0), (width - b, 0), (width, e), (width, height - f), (width - c, height), (d, height), (0, height - g), (0, h)]


def random_cuts(rng: np.random.Generator, length: float, low: float, high: float) -> list[float]:
    """0 = c0 < c1 < ... = length with every gap between low and about high."""
    cuts = [0.0]
    while length - cuts[-1] > max(high, 2 * low):
        cuts.append(cuts[-1] + rng.uniform(low, min(high, length - cuts[-1] - low)))
    return [*cuts, length]


def random_doors(rng: np.random.Generator, low: float, high: float, count: int) -> list[tuple[float, float]]:
    """(from, to) of `count` openings along a wall, clear of its ends and of one another."""
    doors = []
    part = (high - low) / count
    for i in range(count):
        door = float(rng.uniform(*DOOR_M))
        a = low + i * part
        start = rng.uniform(a + 0.35, max(a + 0.36, a + part - door - 0.35))
        doors.append((start, start + door))
    return doors


def wall_along_x(x0: float, x1: float, y: float, doors: list[tuple[float, float]]) -> Shape:
    edges = [x0 - WALL_M / 2, *(edge for door in doors for edge in door), x1 + WALL_M / 2]
    half = WALL_M / 2
    return np.concatenate([polygon([(a, y - half), (b, y - half), (b, y + half), (a, y + half)]) for a, b in _pairs(edges)])


def wall_along_y(x: float, y0: float, y1: float, doors: list[tuple[float, float]]) -> Shape:
    return wall_along_x(y0, y1, x, doors)[:, [1, 0, 3, 2]]


def _pairs(edges: list[float]) -> list[tuple[float, float]]:
    return list(zip(edges[::2], edges[1::2], strict=True))


def turned_box(rng: np.random.Generator, x: float, y: float, length: float, depth: float) -> Shape:
    turn = rng.uniform(0, math.pi)
    c, s = math.cos(turn), math.sin(turn)
    corners = np.array([(-length, -depth), (length, -depth), (length, depth), (-length, depth)]) / 2
    return polygon(corners @ np.array([[c, s], [-s, c]]) + (x, y))
