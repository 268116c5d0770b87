"""Places a simulated robot can drive in: walls as line segments in metres, and the truth as a grid.

A world file lists one thing a line; `#` starts a comment:

    0 0  12.5 0            a wall from (0, 0) to (12.5, 0)
    circle 4 3 0.3         a pillar, as a polygon inscribed in the circle
    start 1.5 2 90         where a robot may start: x, y in metres, heading in degrees
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from hw.errors import DeviceConfigError
from protocol.geometry import SE2
from protocol.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

ROBOT_RADIUS_M = 0.2
MAX_SEGMENTS = 20_000
MAX_EXTENT_M = 500.0
MAX_FILE_BYTES = 4 << 20  # 20,000 walls take 1.2 MB when each number has 12 digits


@dataclass(frozen=True, eq=False)
class World:
    """Walls, and where robots may start.  Immutable; derived grids are cached."""

    name: str
    segments: NDArray[np.float64]  # (S, 4) x0, y0, x1, y1 in metres
    starts: tuple[SE2, ...] = ()  # every one can reach every other
    _grids: dict[float, OccupancyGrid] = field(default_factory=dict, repr=False)

    @staticmethod
    def of(name: str, shapes: Iterable[ArrayLike], starts: Iterable[SE2] = ()) -> World:
        """From (N, 4) arrays of segments."""
        parts = [np.asarray(shape, dtype=np.float64).reshape(-1, 4) for shape in shapes]
        segments = np.concatenate(parts) if parts else np.zeros((0, 4))
        lengths_m = np.hypot(segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1])
        return World(name, np.ascontiguousarray(segments[lengths_m > 1e-6]), tuple(starts))

    @staticmethod
    def parse(text: str, name: str) -> World:
        """Read a world file's text."""
        shapes: list[NDArray[np.float64]] = []
        starts = []
        for number, line in enumerate(text.splitlines(), start=1):
            words = line.split("#")[0].split()
            if not words:
                continue
            kind = words.pop(0) if words[0] in ("circle", "start") else "wall"
            values = _numbers(words, 4 if kind == "wall" else 3, f"{name}:{number}")
            if kind == "wall":
                shapes.append(np.array([values]))
            elif kind == "circle":
                if values[2] <= 0:
                    raise DeviceConfigError(f"{name}:{number}: a circle of radius {values[2]:g}; give one above 0")
                shapes.append(polygon(circle_points(values[0], values[1], values[2])))
            else:
                starts.append(SE2(values[0], values[1], math.radians(values[2])))
        world = World.of(name, shapes, starts)
        if not 0 < len(world.segments) <= MAX_SEGMENTS:
            raise DeviceConfigError(
                f"{name}: {len(world.segments)} walls; a world has 1 to {MAX_SEGMENTS}, one 'x0 y0 x1 y1' a line"
            )
        return world

    @cached_property
    def bounds(self) -> tuple[float, float, float, float]:
        """x_min, y_min, x_max, y_max of all walls."""
        x, y = self.segments[:, [0, 2]], self.segments[:, [1, 3]]
        return float(x.min()), float(y.min()), float(x.max()), float(y.max())

    def truth(self, resolution_m: float = 0.05) -> OccupancyGrid:
        """The map a perfect robot would draw: walls occupied, what can be reached from the starts free, the rest unknown."""
        if resolution_m not in self._grids:
            self._grids[resolution_m] = _rasterise(self, resolution_m)
        return self._grids[resolution_m]

    def start_poses(self, n: int, seed: int = 0, spacing_m: float = 6.0) -> list[SE2]:
        """n starts, the first listed ones if the world lists that many; else free places about `spacing_m` of way apart."""
        if len(self.starts) >= n:
            rng = np.random.default_rng(seed)
            return list(self.starts[:n]) if seed == 0 else [self.starts[i] for i in rng.permutation(len(self.starts))[:n]]
        from hw.sim.places import spread_starts  # noqa: PLC0415  (places needs World)

        return spread_starts(self, n, seed, spacing_m)


def open_world(spec: str) -> World:
    """`office`, `office?seed=3`, `outdoor`, `random?seed=7`, or the path of a world file."""
    from hw.sim import worlds  # noqa: PLC0415  (worlds needs World)

    name, _, query = spec.partition("?")
    if name in worlds.BUILT_IN:
        return worlds.BUILT_IN[name](_seed(spec, name, query))
    path = next((path for path in (spec, name) if os.path.isfile(path)), None)  # a file's name may hold a ? of its own
    if path is None:
        names = ", ".join(sorted(worlds.BUILT_IN))
        raise DeviceConfigError(f"{spec}: neither a built-in world ({names}) nor a file")
    return World.parse(_text(path), path)


def _seed(spec: str, name: str, query: str) -> int:
    """Of a built-in world."""
    key, _, value = query.partition("=")
    if query and not (key == "seed" and value.isascii() and value.isdecimal()):
        raise DeviceConfigError(f"{spec}: '?{query}' is no seed; give a whole number, as in {name}?seed=3")
    return int(value or 0)


def _text(path: str) -> str:
    try:
        with Path(path).open("rb") as stream:
            data = stream.read(MAX_FILE_BYTES + 1)
    except OSError as error:
        raise DeviceConfigError(f"{path}: cannot be read: {error.strerror}; is this the world's name?") from error
    if len(data) > MAX_FILE_BYTES:
        raise DeviceConfigError(f"{path}: over {MAX_FILE_BYTES} bytes; is this really a list of walls?")
    return data.decode("utf-8-sig", "replace")


def polygon(points: ArrayLike) -> NDArray[np.float64]:
    """(N, 4) closed outline through (N, 2) corners."""
    corners = np.asarray(points, dtype=np.float64)
    return np.hstack([corners, np.roll(corners, -1, axis=0)])


def box(x0: float, y0: float, x1: float, y1: float) -> NDArray[np.float64]:
    return polygon([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])


def circle_points(x: float, y: float, radius_m: float) -> NDArray[np.float64]:
    """Corners of a polygon that is within 2 mm of the circle."""
    n = int(np.clip(math.ceil(math.pi / math.acos(max(0.0, 1 - 0.002 / max(radius_m, 0.01)))), 8, 64))
    angles = np.arange(n) * (math.tau / n)
    return np.column_stack([x + radius_m * np.cos(angles), y + radius_m * np.sin(angles)])


def _numbers(words: list[str], count: int, where: str) -> list[float]:
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) != count or not all(math.isfinite(v) and abs(v) <= MAX_EXTENT_M for v in values):
        raise DeviceConfigError(
            f"{where}: {' '.join(words)[:60]!r}; expected {count} numbers of at most {MAX_EXTENT_M:.0f}: "
            "a wall is 'x0 y0 x1 y1'; others are 'circle x y radius', 'start x y degrees'"
        )
    return values


def _rasterise(world: World, resolution_m: float) -> OccupancyGrid:
    """Walls by sampling each segment densely (so that a cell is occupied when a wall passes through it), then flood fill."""
    x0, y0, x1, y1 = world.bounds
    margin = 2
    width = math.ceil((x1 - x0) / resolution_m) + 2 * margin + 1
    height = math.ceil((y1 - y0) / resolution_m) + 2 * margin + 1
    left, bottom = x0 - margin * resolution_m, y0 - margin * resolution_m
    # Half a cell off the walls' own round coordinates, so that a wall falls inside a cell and not on the border of two.
    left, bottom = left - resolution_m / 2, bottom - resolution_m / 2
    cells = np.full((height, width), UNKNOWN, np.int8)
    points = sample_walls(world.segments, resolution_m / 4)
    rows = ((points[:, 1] - bottom) / resolution_m).astype(np.int64)
    cols = ((points[:, 0] - left) / resolution_m).astype(np.int64)
    cells[rows, cols] = OCCUPIED
    grid = OccupancyGrid(cells, resolution_m, SE2(left, bottom, 0.0))
    _fill_free(grid, world.starts)
    return grid


def sample_walls(segments: NDArray[np.float64], step_m: float) -> NDArray[np.float64]:
    """(N, 2) points along all segments, at most `step_m` apart, ends included."""
    lengths_m = np.hypot(segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1])
    counts = np.maximum(2, np.ceil(lengths_m / step_m).astype(np.int64) + 1)
    owner = np.repeat(np.arange(len(segments)), counts)
    place = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    t = (place / (counts[owner] - 1))[:, None]
    return np.asarray(segments[owner, :2] * (1 - t) + segments[owner, 2:] * t)


def _fill_free(grid: OccupancyGrid, starts: tuple[SE2, ...]) -> None:
    """Mark as free what is connected with a start; without starts, the largest closed area."""
    open_cells = (grid.cells == UNKNOWN).astype(np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(open_cells, connectivity=4)
    outside = labels[0, 0]
    if starts:
        at = grid.cells_at([(s.x_m, s.y_m) for s in starts])
        wanted = {int(labels[row, col]) for row, col in at if 0 <= row < grid.height and 0 <= col < grid.width}
    else:
        areas = stats[:, cv2.CC_STAT_AREA].copy()
        areas[0] = areas[outside] = 0
        wanted = {int(np.argmax(areas))} if areas.any() else {int(outside)}
    grid.cells[np.isin(labels, list(wanted - {0})) & (open_cells > 0)] = FREE
