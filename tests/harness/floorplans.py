"""Small seeded floor plans, drawn as a robot would map them: any part, any frame, any resolution, with or without noise."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from protocol.geometry import SE2
from protocol.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

_SHIFT = 4  # fractional bits of cv2's drawing coordinates


@dataclass(frozen=True, eq=False)
class FloorPlan:
    """Walls as segments and pillars as circles, inside a rectangle, in metres of the world frame."""

    walls: NDArray[np.float64]  # (N, 4) x0 y0 x1 y1
    pillars: NDArray[np.float64]  # (M, 3) x y radius
    width_m: float
    height_m: float

    def mapped(
        self,
        T_map_world: SE2,
        resolution_m: float = 0.1,
        x_range_m: tuple[float, float] = (-1.0, 1e3),
        noise_m: float = 0.0,
        seed: int = 0,
        hit: bool = False,
    ) -> OccupancyGrid:
        """The map of everything between two x of the world, in a frame of one's own; its origin is its lower-left corner.

        Walls are lines of pixels, which lie up to a third of a cell beside the true ones; or where beams would `hit` them.
        """
        low, high = max(-0.2, x_range_m[0]), min(self.width_m + 0.2, x_range_m[1])
        area = np.array([[low, -0.2], [high, -0.2], [high, self.height_m + 0.2], [low, self.height_m + 0.2]])
        inside = np.array([[low, 0], [high, 0], [high, self.height_m], [low, self.height_m]]).clip(
            0, [self.width_m, self.height_m]
        )
        corner = np.floor(T_map_world.apply(area).min(axis=0) / resolution_m - 2) * resolution_m
        size = np.ceil((T_map_world.apply(area).max(axis=0) - corner) / resolution_m + 2).astype(int)

        def cells(points_m: NDArray[np.float64]) -> NDArray[np.int32]:
            px = (T_map_world.apply(points_m) - corner) / resolution_m - 0.5
            return np.rint(px * (1 << _SHIFT)).astype(np.int32)

        known, seen = np.zeros((2, size[1], size[0]), np.uint8)
        cv2.fillPoly(known, [cells(inside)], 1, shift=_SHIFT)
        cv2.fillPoly(seen, [cells(area)], 1, shift=_SHIFT)
        grid = np.where(known > 0, FREE, UNKNOWN).astype(np.int8)
        wall = np.zeros_like(known)
        for a, b in zip(cells(self.walls[:, :2]), cells(self.walls[:, 2:]), strict=True):
            cv2.line(wall, a.tolist(), b.tolist(), 1, 1, shift=_SHIFT)
        for x, y, radius in self.pillars:
            turns = np.linspace(0, 2 * np.pi, 60, endpoint=False)
            rim = np.column_stack([x + radius * np.cos(turns), y + radius * np.sin(turns)])
            cv2.fillPoly(grid.view(np.uint8), [cells(rim)], 255, shift=_SHIFT)
            cv2.polylines(wall, [cells(rim)], True, 1, 1, shift=_SHIFT)
        if hit:
            surface = T_map_world.apply(self._surface(resolution_m / 2))
            surface += np.random.default_rng(seed).normal(0, noise_m, surface.shape)
            wall = _hit((surface - corner) / resolution_m, wall.shape)
        else:
            wall = _scattered(wall, noise_m / resolution_m, seed)
        grid[(wall & seen) > 0] = OCCUPIED
        return OccupancyGrid(grid, resolution_m, SE2(float(corner[0]), float(corner[1]), 0.0))

    def _surface(self, spacing_m: float) -> NDArray[np.float64]:
        """(N, 2) points along all walls and around all pillars, world frame: what beams hit."""
        ends = [(w[:2], w[2:]) for w in self.walls]
        turns = [np.arange(0, 2 * np.pi, spacing_m / radius) for _, _, radius in self.pillars]
        rims = [p[:2] + p[2] * np.stack([np.cos(t), np.sin(t)], axis=1) for p, t in zip(self.pillars, turns, strict=True)]
        straight = [a + np.arange(0, 1, spacing_m / max(spacing_m, np.hypot(*(b - a))))[:, None] * (b - a) for a, b in ends]
        return np.concatenate([*straight, *rims])


def _hit(cells_xy: NDArray[np.float64], shape: tuple[int, ...]) -> NDArray[np.uint8]:
    """1 where a point falls into the cell."""
    col, row = np.floor(cells_xy).astype(int).T
    inside = (row >= 0) & (col >= 0) & (row < shape[0]) & (col < shape[1])
    image = np.zeros(shape, np.uint8)
    image[row[inside], col[inside]] = 1
    return image


def _scattered(wall: NDArray[np.uint8], sigma_cells: float, seed: int) -> NDArray[np.uint8]:
    if sigma_cells == 0:
        return wall
    rc = np.argwhere(wall)
    rc = np.rint(rc + np.random.default_rng(seed).normal(0, sigma_cells, rc.shape)).astype(int)
    out = np.zeros_like(wall)
    rc = rc.clip(0, np.array(wall.shape) - 1)
    out[rc[:, 0], rc[:, 1]] = 1
    return out


def office(seed: int, rooms: int = 7) -> FloorPlan:
    """A corridor with rooms of different widths on both sides, doors, a few slanted screens and round pillars."""
    rng = np.random.default_rng(seed)
    depth, corridor = rng.uniform(3.5, 6.0, 2), rng.uniform(1.6, 2.4)
    low, high, top = depth[0], depth[0] + corridor, depth[0] + corridor + depth[1]
    width = 4.0 * rooms
    walls = [(0, 0, width, 0), (0, top, width, top), (0, 0, 0, top), (width, 0, width, top)]
    pillars = []
    for y_door, y_far in ((low, 0.0), (high, top)):
        cuts = np.r_[0, np.sort(rng.uniform(2, width - 2, rooms - 1)), width]
        for left, right in itertools.pairwise(cuts):
            walls.append((right, y_door, right, y_far))
            door = left + rng.uniform(0.2, 0.6) * max(0.5, right - left - 1)
            walls += [(left, y_door, door, y_door), (min(door + 0.9, right), y_door, right, y_door)]
            x, y = (left + right) / 2, (y_door + y_far) / 2
            if right - left > 2.5:
                angle, half = rng.uniform(0, np.pi), rng.uniform(0.5, 1.0)
                walls.append(
                    (x - half * np.cos(angle), y - half * np.sin(angle), x + half * np.cos(angle), y + half * np.sin(angle))
                )
            if right - left > 4.0:
                pillars.append((left + 1.0, y, rng.uniform(0.3, 0.6)))
    return FloorPlan(np.array(walls, np.float64), np.array(pillars, np.float64).reshape(-1, 3), width, float(top))
