"""The built-in worlds, each drawn from a seed: no two rooms alike, so that a place can be told from its shape.

`office`   a corridor with rooms of different widths on both sides, a lobby with pillars and a slanted wall, furniture
`outdoor`  a yard with an irregular hedge, buildings at odd angles, trees and parked cars
`random`   rooms by random splitting, then clutter
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from hw.sim.building import (
    Rect,
    Shape,
    chipped_outline,
    furnished,
    random_cuts,
    random_doors,
    turned_box,
    wall_along_x,
    wall_along_y,
)
from hw.sim.world import World, circle_points, polygon


def office(seed: int = 0) -> World:
    """About 24 x 15 m around one corridor, with a lobby open to it."""
    return _first_connected(_office, f"office?seed={seed}", 1, seed)


def random_rooms(seed: int = 0) -> World:
    """Rooms by splitting a rectangle again and again; doors in every split, two in the long ones."""
    return _first_connected(_random_rooms, f"random?seed={seed}", 2, seed)


def _first_connected(make: Callable[[np.random.Generator, str], World | None], name: str, kind: int, seed: int) -> World:
    """The first attempt in which no door opens against a wall."""
    for attempt in range(100):
        world = make(np.random.default_rng([kind, seed, attempt]), name)
        if world is not None:
            return world
    raise AssertionError(f"{name}: no connected world in 100 attempts")


def _office(rng: np.random.Generator, name: str) -> World | None:
    width, height = rng.uniform(22, 26), rng.uniform(14, 16)
    south, north = height * rng.uniform(0.38, 0.44), height * rng.uniform(0.53, 0.58)
    shapes: list[Shape] = [polygon(chipped_outline(rng, width, height))]
    north_cuts, south_cuts = random_cuts(rng, width, 3.2, 5.6), random_cuts(rng, width, 2.8, 5.2)
    lobby = int(rng.integers(1, len(north_cuts) - 2))
    rooms: list[Rect] = []
    for cuts, y_corridor, y_outer in ((north_cuts, north, height), (south_cuts, south, 0.0)):
        is_north = y_outer > 0
        for i in range(len(cuts) - 1):
            x0, x1 = cuts[i], cuts[i + 1]
            is_lobby = is_north and i == lobby
            if not is_lobby:
                shapes.append(
                    wall_along_x(x0, x1, y_corridor, random_doors(rng, x0, x1, 1 if x1 - x0 < 4.6 else int(rng.integers(1, 3))))
                )
                rooms.append((x0, min(y_corridor, y_outer), x1, max(y_corridor, y_outer)))
            if i > 0:
                low, high = sorted((y_corridor, y_outer))
                linked = not is_lobby and rng.random() < 0.3
                shapes.append(wall_along_y(x0, low, high, random_doors(rng, low, high, 1) if linked else []))
    shapes += _lobby_shapes(rng, north_cuts[lobby], north_cuts[lobby + 1], north, height)
    return furnished(rng, World.of(name, shapes), rooms, 0.16, _corridor_shapes(rng, width, south, north))


def _random_rooms(rng: np.random.Generator, name: str) -> World | None:
    width, height = rng.uniform(14, 24), rng.uniform(10, 18)
    shapes: list[Shape] = [polygon(chipped_outline(rng, width, height))]
    rooms: list[Rect] = []
    _split(rng, (0.0, 0.0, width, height), shapes, rooms)
    return furnished(rng, World.of(name, shapes), rooms, 0.2)


def outdoor(seed: int = 0) -> World:
    """About 34 x 26 m: few straight lines, many round ones."""
    rng = np.random.default_rng([3, seed])
    width, height = rng.uniform(30, 36), rng.uniform(22, 28)
    shapes: list[Shape] = [polygon(_hedge(rng, width, height))]
    taken: list[tuple[float, float, float]] = []
    makers: list[tuple[int, float, Callable[[float, float], Shape]]] = [
        (4, 3.6, lambda x, y: turned_box(rng, x, y, rng.uniform(3, 5.5), rng.uniform(2, 3.5))),
        (6, 2.6, lambda x, y: turned_box(rng, x, y, 4.2, 1.8)),
        (9, 1.6, lambda x, y: _bush(rng, x, y)),
        (22, 1.0, lambda x, y: polygon(circle_points(x, y, float(rng.uniform(0.12, 0.4))))),
    ]
    for count, room_m, make in makers:
        placed = 0
        for _ in range(count * 6):
            x, y = rng.uniform(2, width - 2), rng.uniform(2, height - 2)
            if placed < count and all(math.hypot(x - a, y - b) > room_m + r for a, b, r in taken):
                shapes.append(make(x, y))
                taken.append((x, y, room_m * 0.8))
                placed += 1
    return World.of(f"outdoor?seed={seed}", shapes)


BUILT_IN: dict[str, Callable[[int], World]] = {"office": office, "outdoor": outdoor, "random": random_rooms}


def _lobby_shapes(rng: np.random.Generator, x0: float, x1: float, y0: float, y1: float) -> list[Shape]:
    """Open to the corridor: two pillars, a round table, one slanted corner."""
    slant = rng.uniform(1.0, 1.8)
    corner = [(x1 - slant, y1), (x1, y1 - slant * rng.uniform(0.6, 1.3))]
    pillars = [circle_points(x0 + (x1 - x0) * k, y0 + rng.uniform(0.3, 0.9), rng.uniform(0.16, 0.26)) for k in (0.3, 0.75)]
    table = circle_points(x0 + (x1 - x0) * 0.45, (y0 + y1) / 2 + 0.7, rng.uniform(0.45, 0.7))
    return [np.array([[*corner[0], *corner[1]]]), *map(polygon, pillars), polygon(table)]


def _corridor_shapes(rng: np.random.Generator, width: float, south: float, north: float) -> list[Shape]:
    """Cupboards and half-round columns against the corridor walls, never narrowing it below a metre."""
    shapes: list[Shape] = []
    depth_max = north - south - 1.25
    for x in np.arange(1.5, width - 1.5, 3.1) + rng.uniform(-0.6, 0.6):
        depth = float(rng.uniform(0.15, max(0.16, min(0.4, depth_max))))
        length = float(rng.uniform(0.3, 1.3))
        if rng.random() < 0.55:
            y0, y1 = (south, south + depth) if rng.random() < 0.5 else (north - depth, north)
            shapes.append(polygon([(x, y0), (x + length, y0), (x + length, y1), (x, y1)]))
    return shapes


def _split(rng: np.random.Generator, room: Rect, shapes: list[Shape], rooms: list[Rect]) -> None:
    x0, y0, x1, y1 = room
    w, h = x1 - x0, y1 - y0
    if max(w, h) < 5.5 or (w * h < 26 and rng.random() < 0.6):
        rooms.append(room)
        return
    k = rng.uniform(0.36, 0.64)
    if w > h:
        x = x0 + k * w
        shapes.append(wall_along_y(x, y0, y1, random_doors(rng, y0, y1, 2 if h > 7 else 1)))
        halves = [(x0, y0, x, y1), (x, y0, x1, y1)]
    else:
        y = y0 + k * h
        shapes.append(wall_along_x(x0, x1, y, random_doors(rng, x0, x1, 2 if w > 7 else 1)))
        halves = [(x0, y0, x1, y), (x0, y, x1, y1)]
    for half in halves:
        _split(rng, half, shapes, rooms)


def _bush(rng: np.random.Generator, x: float, y: float) -> Shape:
    angles = np.sort(rng.uniform(0, math.tau, 9))
    radii = rng.uniform(0.35, 0.9, 9)
    return polygon(np.column_stack([x + radii * np.cos(angles), y + radii * np.sin(angles)]))


def _hedge(rng: np.random.Generator, width: float, height: float) -> Shape:
    """A closed outline that wanders about a metre off a rectangle."""
    corners = [(0.0, 0.0), (width, 0.0), (width, height), (0.0, height)]
    points = []
    for (ax, ay), (bx, by) in zip(corners, corners[1:] + corners[:1], strict=True):
        n = int(math.hypot(bx - ax, by - ay) / 1.8)
        for t in np.arange(n) / n:
            points.append((ax + t * (bx - ax) + rng.uniform(-0.7, 0.7), ay + t * (by - ay) + rng.uniform(-0.7, 0.7)))
    return np.array(points)
