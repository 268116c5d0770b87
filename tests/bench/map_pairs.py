"""Pairs of maps with a known transform: two simulated robots in one building, and pairs of the evaluation kit's recordings.

Simulated robots walk between random places of a world and draw what a noisy LIDAR sees, each in a frame of its own.  Kit pairs
are read from `BENCH_DATA` (built by `python -m bench build` in ../shared); without it there are none, and a sentence says so.
"""

from __future__ import annotations

import json
import math
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from agent.mapping.log_odds import LogOddsGrid
from hw.sim.places import Clearance, Ways
from hw.sim.raycast import cast
from hw.sim.world import World, open_world
from protocol.geometry import SE2, wrap_angle
from protocol.grid import OccupancyGrid

BEAMS = 360
RANGE_M = 12.0
NOISE_M = 0.02
SCAN_EVERY_M = 0.4
WRONG_M, WRONG_RAD = 0.5, math.radians(3)  # the kit's bar for a right transform


@dataclass(frozen=True, slots=True, eq=False)
class MapPair:
    name: str
    ours: OccupancyGrid
    theirs: OccupancyGrid
    truth: SE2 | None  # T_ours_theirs; None: different places, nothing to merge
    middle_m: tuple[float, float] = (0.0, 0.0)  # where the error is taken, their frame

    def errors(self, T: SE2) -> tuple[float, float]:
        """Metres at the middle of the overlap, and radians."""
        if self.truth is None:
            return math.inf, math.inf
        away = T.apply([self.middle_m])[0] - self.truth.apply([self.middle_m])[0]
        return float(np.hypot(*away)), abs(wrap_angle(T.theta_rad - self.truth.theta_rad))

    def is_right(self, T: SE2) -> bool:
        metres, radians = self.errors(T)
        return metres < WRONG_M and radians < WRONG_RAD


def simulated_pairs(worlds: list[str], resolution_m: float, walk_m: float = 45.0) -> Iterator[MapPair]:
    """Two robots in each world, and each first robot with the second of the next world as a pair that must not merge."""
    seen = []
    for number, spec in enumerate(worlds):
        world = open_world(spec)
        starts = world.start_poses(2)
        rng = np.random.default_rng([number, 5])
        frames = [SE2(*rng.uniform(-20, 20, 2), float(rng.uniform(-math.pi, math.pi))) for _ in range(2)]
        grids = [mapped(world, starts[i], frames[i], walk_m, resolution_m, seed=10 * number + i) for i in range(2)]
        seen.append(grids)
        T = frames[0] @ frames[1].inverse()
        yield MapPair(spec, grids[0], grids[1], T, overlap_middle(grids[0], grids[1], T))
    for i in range(len(worlds)):
        j = (i + 1) % len(worlds)
        yield MapPair(f"{worlds[i]} x {worlds[j]}", seen[i][0], seen[j][1], None)


def mapped(world: World, start: SE2, T_map_world: SE2, walk_m: float, resolution_m: float, seed: int) -> OccupancyGrid:
    """What a robot has drawn after so many metres between random places, with perfect poses."""
    rng = np.random.default_rng(seed)
    grid = LogOddsGrid(resolution_m)
    bearings = np.linspace(-math.pi, math.pi, BEAMS, endpoint=False)
    for x, y in _walk(world, start, walk_m, rng):
        ranges, _ = cast(world.segments, np.tile((x, y), (BEAMS, 1)), bearings, RANGE_M)
        is_hit = np.isfinite(ranges)
        ranges = np.where(is_hit, ranges + rng.normal(0, NOISE_M, BEAMS), RANGE_M)
        ends = np.column_stack([x + ranges * np.cos(bearings), y + ranges * np.sin(bearings)])
        laser = T_map_world.apply([(x, y)])[0]
        grid.add((float(laser[0]), float(laser[1])), T_map_world.apply(ends), is_hit, clears=True)
    return grid.trinary().cropped(2)


def _walk(world: World, start: SE2, walk_m: float, rng: np.random.Generator) -> list[tuple[float, float]]:
    """Places a scan apart, along ways between random goals."""
    radius_m = 0.25
    clearance = Clearance.of(world, 0.2)
    ways = Ways(clearance, radius_m)
    at, walked, places = (start.x_m, start.y_m), 0.0, [(start.x_m, start.y_m)]
    while walked < walk_m:
        lengths = ways.lengths_from(at)
        rows, cols = np.nonzero(np.isfinite(lengths) & (lengths > 3) & (lengths < 20))
        if not len(rows):
            break
        goal = int(rng.integers(len(rows)))
        path = np.array(ways.path(lengths, (int(rows[goal]), int(cols[goal])), radius_m))
        steps = np.hypot(*np.diff(path, axis=0).T)
        along = np.arange(SCAN_EVERY_M, steps.sum(), SCAN_EVERY_M)
        done = np.concatenate([[0], np.cumsum(steps)])
        places += list(zip(np.interp(along, done, path[:, 0]), np.interp(along, done, path[:, 1]), strict=True))
        walked += float(steps.sum())
        at = (float(path[-1, 0]), float(path[-1, 1]))
    return places


def overlap_middle(ours: OccupancyGrid, theirs: OccupancyGrid, T: SE2) -> tuple[float, float]:
    points = theirs.points_of(np.argwhere(theirs.known()))
    common = points[ours.values_at(T.apply(points)) >= 0]
    middle = (common if len(common) else points).mean(axis=0)
    return float(middle[0]), float(middle[1])


def kit_pairs(which: str, kind: str | None = None, stride: int = 1) -> Iterator[MapPair]:
    """Pairs of one set of the kit (`main`, `res20`, `degraded`), every `stride`-th of each kind."""
    folder = Path(os.environ.get("BENCH_DATA", "~/.cache/mapquilt-bench/data")).expanduser() / which
    index = folder / "pairs.json"
    if not index.is_file():
        print(f"no kit at {folder}: build it with `cd ../shared && python -m bench build`, or set BENCH_DATA", file=sys.stderr)
        return
    rows = [row for row in json.loads(index.read_text()) if kind is None or row["kind"] == kind]
    for row in rows[::stride]:
        grids = []
        for side in "ab":
            with np.load(folder / "maps" / f"{row['id']}_{side}.npz") as archive:
                grids.append(OccupancyGrid(archive["grid"], row["res"]))
        truth = None if row["gt"] is None else SE2(*row["gt"])
        logs = row["log_a"] if row["log_a"] == row["log_b"] else f"{row['log_a']} x {row['log_b']}"
        yield MapPair(f"{row['id']} {logs} {row['res']:.2f}", grids[0], grids[1], truth, tuple(row["ref"] or (0.0, 0.0)))
