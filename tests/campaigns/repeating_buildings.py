"""Buildings that repeat themselves, as a scanner sees parts of them.

Hotels of one kind of room, racking, rotundas, garages, classrooms of one size, long halls between two rows of columns.

Two parts of such a building without a place in common fit each other elsewhere nearly perfectly, and so do two of its kind.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from agent.mapping.log_odds import LogOddsGrid
from hw.sim.building import turned_box, wall_along_x, wall_along_y
from hw.sim.places import Clearance
from hw.sim.raycast import cast
from hw.sim.world import World, box, circle_points, polygon
from protocol.geometry import SE2
from protocol.grid import OccupancyGrid

REACH_M = 3.0  # of a scanner that sees one part: two parts four tenths of a building apart have no cell in common
BEAMS = 360
RANGE_NOISE_M = 0.015
RESOLUTION_M = 0.1
FREE_BELOW = 0.41  # one beam that passes makes a cell free: no place is scanned twice
STANDING_ROOM_M = 0.35
DOOR_M = 0.9
Part = tuple[float, float]  # shares of the building's width between which the scanner stood
WHOLE: Part = (0.0, 1.0)
ENDS: tuple[Part, Part] = ((0.0, 0.3), (0.7, 1.0))


def hotel(rng: np.random.Generator) -> World:
    """One kind of room on both sides of a corridor, those opposite turned by 180 degrees: no mirror image of itself."""
    count, pitch, depth = int(rng.integers(6, 10)), rng.uniform(3.0, 4.0), rng.uniform(3.5, 5.0)
    corridor, door, bed = rng.uniform(1.5, 2.0), rng.uniform(0.3, 0.8), rng.uniform(0.8, 1.6)
    width, height = count * pitch, 2 * depth + corridor
    doors = [(k * pitch + door, k * pitch + door + DOOR_M) for k in range(count)]
    side = [wall_along_x(0.0, width, depth, doors)]
    side += [wall_along_y(k * pitch, 0.0, depth, []) for k in range(1, count)]
    for x in pitch * np.arange(count):
        side += [box(x + 1.4, 0.0, x + pitch - 0.3, bed), wall_along_x(x + pitch - 1.3, x + pitch, depth - 1.5, [])]
        side.append(wall_along_y(x + pitch - 1.3, depth - 1.5, depth - 0.6, []))
    half = np.concatenate(side)
    return World.of("hotel", [box(0.0, 0.0, width, height), half, np.tile([width, height], 2) - half])


def racking(rng: np.random.Generator) -> World:
    """Rows of racks, few of which are missing, and some pallets."""
    width, height = rng.uniform(20, 30), rng.uniform(14, 19)
    aisle, length, depth = rng.uniform(2, 3), rng.uniform(4, 7), rng.uniform(0.6, 1.0)
    shapes = [box(0.0, 0.0, width, height)]
    for y in np.arange(2.0, height - 2.0 - depth, aisle + depth):
        for x in np.arange(2.0, width - 1.5 - length, length + 1.8):
            if rng.random() < 0.93:
                shapes.append(box(x, y, x + length, y + depth))
    for _ in range(rng.integers(1, 5)):
        shapes.append(turned_box(rng, rng.uniform(2, width - 2), rng.uniform(2, height - 2), 1.1, 0.9))
    return World.of("racking", shapes)


def rotunda(rng: np.random.Generator) -> World:
    """Rooms of about one size around a round hall, with a door each, and columns here and there."""
    radius = rng.uniform(8.5, 12.0)
    inner, count = radius * rng.uniform(0.35, 0.5), int(rng.integers(5, 9))
    turns = rng.uniform(0, math.tau) + np.cumsum(math.tau / count * rng.uniform(0.85, 1.15, count))
    shapes = [polygon(circle_points(0.0, 0.0, radius))]
    for turn, following in zip(turns, [*turns[1:], turns[0] + math.tau], strict=True):
        door = turn + rng.uniform(0.2, 0.4)
        spoke = np.array([[inner], [radius]]) * (math.cos(turn), math.sin(turn))
        shapes += [spoke.reshape(1, 4), _arc(inner, turn, door), _arc(inner, door + DOOR_M / inner, following)]
    for _ in range(rng.integers(8, 18)):
        away, turn = rng.uniform(1.0, radius - 0.7), rng.uniform(0, math.tau)
        x, y = away * math.cos(turn), away * math.sin(turn)
        if rng.random() < 0.5:
            shapes.append(polygon(circle_points(x, y, rng.uniform(0.1, 0.4))))
        else:
            shapes.append(turned_box(rng, x, y, rng.uniform(0.4, 1.5), rng.uniform(0.3, 0.7)))
    return World.of("rotunda", shapes)


def garage(rng: np.random.Generator) -> World:
    """Columns at equal distances along an aisle, cars of one size in two of five bays, and stairs at one end."""
    count, pitch, depth = int(rng.integers(6, 9)), rng.uniform(4.8, 5.4), rng.uniform(4.8, 5.2)
    aisle, column = rng.uniform(5.5, 6.5), rng.uniform(0.3, 0.6)
    width, height = count * pitch, 2 * depth + aisle
    shapes = [box(0.0, 0.0, width, height), box(0.0, depth, rng.uniform(1.5, 3.0), depth + rng.uniform(2.5, 4.0))]
    for x in pitch * np.arange(1, count) - column / 2:
        shapes += [box(x, y - column / 2, x + column, y + column / 2) for y in (depth, height - depth)]
    for x in pitch / 2 * np.arange(2 * count):
        for y in (0.4, height - 4.9):
            if rng.random() < 0.4:
                left, low = x + rng.uniform(0.2, 0.5), y + rng.uniform(-0.1, 0.3)
                shapes.append(box(left, low, left + 1.75, low + 4.2))
    return World.of("garage", shapes)


def classrooms(rng: np.random.Generator) -> World:
    """Rooms of one size along a corridor, the desks in rows that nobody measured, few missing; some have a cupboard."""
    count, pitch, depth = int(rng.integers(4, 7)), rng.uniform(7.0, 9.0), rng.uniform(6.0, 7.5)
    corridor, door = rng.uniform(2.0, 3.0), rng.uniform(0.4, 1.0)
    width = count * pitch
    doors = [(k * pitch + door, k * pitch + door + DOOR_M) for k in range(count)]
    shapes = [box(0.0, 0.0, width, depth + corridor), wall_along_x(0.0, width, depth, doors)]
    shapes += [wall_along_y(k * pitch, 0.0, depth, []) for k in range(1, count)]
    for x in pitch * np.arange(count):
        shapes.append(box(x + 0.8, depth - 3.5, x + 1.6, depth - 2.0))
        if rng.random() < 0.7:
            shapes.append(box(x + pitch - 0.6, 1.0, x + pitch - 0.1, 3.0))
        for left in x + np.arange(3.0, pitch - 1.5, 1.9):
            for y in np.arange(1.0, depth - 2.5, 1.7):
                if rng.random() < 0.8:
                    away, low = left + rng.uniform(-0.3, 0.3), y + rng.uniform(-0.3, 0.3)
                    shapes.append(box(away, low, away + 1.3, low + 0.5))
    return World.of("classrooms", shapes)


def hall(rng: np.random.Generator) -> World:
    """Two rows of columns at equal distances, and some benches."""
    count, pitch, height = int(rng.integers(6, 9)), rng.uniform(3.5, 5.0), rng.uniform(9.0, 13.0)
    width, aside, radius = (count + 1) * pitch, rng.uniform(1.5, 2.5), rng.uniform(0.25, 0.5)
    shapes = [box(0.0, 0.0, width, height)]
    for x in pitch * np.arange(1, count + 1):
        shapes += [polygon(circle_points(x, y, radius)) for y in (aside, height - aside)]
    for _ in range(rng.integers(5, 11)):
        x, y = rng.uniform(1.0, width - 1.0), rng.uniform(1.0, height - 1.0)
        shapes.append(turned_box(rng, x, y, rng.uniform(0.5, 2.0), rng.uniform(0.4, 0.8)))
    return World.of("hall", shapes)


KINDS: tuple[Callable[[np.random.Generator], World], ...] = (hotel, racking, rotunda, garage, classrooms, hall)


def _arc(radius_m: float, start: float, end: float) -> NDArray[np.float64]:
    turns = np.linspace(start, max(start, end), 12)
    points = radius_m * np.column_stack([np.cos(turns), np.sin(turns)])
    return np.hstack([points[:-1], points[1:]])


def seen(rng: np.random.Generator, world: World, part: Part = WHOLE, reach_m: float = 10.0, stops: int = 30) -> OccupancyGrid:
    """The map that scans from random places in this part draw, in a frame of its own."""
    grid = LogOddsGrid(RESOLUTION_M, free_below=FREE_BELOW)
    T_map_world = SE2(*rng.uniform((-20, -20, -math.pi), (20, 20, math.pi)).tolist())
    for place in _places(rng, world, part, stops):
        bearings = rng.uniform(0, math.tau) + math.tau / BEAMS * np.arange(BEAMS, dtype=np.float64)
        ranges, _ = cast(world.segments, np.tile(place, (BEAMS, 1)), bearings, reach_m)
        is_hit = np.isfinite(ranges)
        reach = np.where(is_hit, ranges + rng.normal(0, RANGE_NOISE_M, BEAMS), reach_m)
        ends = T_map_world.apply(place + reach[:, None] * np.column_stack([np.cos(bearings), np.sin(bearings)]))
        x, y = T_map_world.apply(place[None])[0]
        grid.add((x, y), ends, is_hit, clears=True)
    return grid.trinary().cropped(2)


def _places(rng: np.random.Generator, world: World, part: Part, count: int) -> NDArray[np.float64]:
    """(N, 2) where a scanner can stand."""
    clearance = Clearance.of(world)
    rows, cols = np.nonzero(clearance.main_place(STANDING_ROOM_M))
    x0, _, x1, _ = world.bounds
    points = np.array([clearance.point((int(r), int(c))) for r, c in zip(rows, cols, strict=True)])
    share = (points[:, 0] - x0) / (x1 - x0)
    points = points[(share >= part[0]) & (share <= part[1])]
    return points[rng.choice(len(points), min(count, len(points)), replace=False)]
