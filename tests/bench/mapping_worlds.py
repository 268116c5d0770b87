"""Mapping where the truth is known: simulated robots explore simulated buildings for ten minutes.

    .venv/bin/python -m tests.bench.mapping_worlds [--minutes 10] [--seeds 0,1,2] [--worlds office,random,outdoor,corridor,loop]
                                                   [--variations plain,...|all] [--json]

A row per run: pose error at the end and at its worst, share of known cells that are right (a wall may lie one cell off),
CPU share of one core for odometry at 50 Hz and (where a variation does not say otherwise) 360 beams at 10 Hz, scans that
were held back, and how many sentences the wheels earn.
Variations are LIDARs, wheels and company that a stranger may have: mapping_drives.py.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray

from agent.mapping.estimate import MapperStatus, ScanOutcome
from agent.mapping.mapper import Mapper
from agent.mapping.options import MappingOptions
from agent.runtime.own_loops import fit_in_own_map
from hw.sim.world import World
from protocol.geometry import SE2
from protocol.grid import FREE, OCCUPIED, OccupancyGrid
from tests.bench.mapping_drives import VARIATIONS, Revolution, explore, world_of
from tests.bench.tables import heading, line


def feed(mapper: Mapper, revolution: Revolution) -> tuple[ScanOutcome, float]:
    """One turn into the filter; what came of it and the CPU seconds it took."""
    started = time.process_time()
    for sample in revolution.odometry:
        mapper.add_odometry(sample)
    outcome = mapper.add_scan(revolution.scan)
    return outcome, time.process_time() - started


def run(name: str, variation: str, seed: int, minutes: float, particles: int) -> dict[str, object]:
    conditions = VARIATIONS[variation]
    options = MappingOptions(particles=particles, matching_range_m=min(conditions.range_m, MappingOptions().matching_range_m))
    world, mapper = world_of(name, seed), Mapper(options, seed, fit_in_own_map)
    errors, cpu_s, held, T_world_map = [], 0.0, 0, None
    for revolution in explore(world, seed, minutes, conditions):
        outcome, spent_s = feed(mapper, revolution)
        cpu_s += spent_s
        held += outcome.status in (MapperStatus.LOST, MapperStatus.BLIND, MapperStatus.STUCK)
        T_world_map = T_world_map or revolution.T_world_robot
        error = (T_world_map @ outcome.T_map_robot).inverse() @ revolution.T_world_robot
        errors.append((math.hypot(error.x_m, error.y_m), math.degrees(abs(error.theta_rad))))
    assert T_world_map is not None
    estimate = mapper.estimate()
    table = np.array(errors)
    return {
        "world": name,
        "variation": variation,
        "seed": seed,
        "end_m": round(float(table[-1, 0]), 4),
        "end_deg": round(float(table[-1, 1]), 3),
        "worst_m": round(float(table[:, 0].max()), 4),
        "worst_deg": round(float(table[:, 1].max()), 3),
        "cells_right": round(cells_right(estimate.grid, T_world_map, world), 5),
        "known_m2": round(estimate.grid.known_area_m2()),
        "cpu_of_core": round(cpu_s / (minutes * 60), 4),
        "held": held,
        "keyframes": len(mapper.map.filter.line),
        "loops": mapper.loops_closed,
        "epoch": mapper.epoch,
        "said": len(list(estimate.wheels.sentences())) if estimate.wheels is not None else 0,
    }


def cells_right(grid: OccupancyGrid, T_world_map: SE2, world: World) -> float:
    """Share of our known cells that the truth confirms: a wall within one cell, or no wall at the very cell."""
    truth = world.truth(grid.resolution_m)
    walls = (truth.cells == OCCUPIED).astype(np.uint8)
    near = cv2.dilate(walls, np.ones((3, 3), np.uint8))
    core = cv2.erode(cv2.dilate(walls, np.ones((3, 3), np.uint8)), np.ones((3, 3), np.uint8))
    return float(
        np.mean(
            np.concatenate(
                [lookup(near, truth, grid, T_world_map, OCCUPIED) == 1, free_right(core, walls, truth, grid, T_world_map)]
            )
        )
    )


def free_right(
    core: NDArray[np.uint8], walls: NDArray[np.uint8], truth: OccupancyGrid, grid: OccupancyGrid, T: SE2
) -> NDArray[np.bool_]:
    """A free cell is wrong when it lies in a wall: on a wall cell all of whose neighbours along one axis are wall or unseen."""
    inside = cv2.erode(core, np.ones((3, 3), np.uint8))
    return lookup(inside, truth, grid, T, FREE) == 0


def lookup(
    layer: NDArray[np.uint8], truth: OccupancyGrid, grid: OccupancyGrid, T_world_map: SE2, value: int
) -> NDArray[np.uint8]:
    """The layer of the truth under every cell of ours that has this value."""
    points = T_world_map.apply(grid.points_of(np.argwhere(grid.cells == value)))
    cells = truth.cells_at(points)
    cells = np.clip(cells, 0, np.array(layer.shape) - 1)
    return layer[cells[:, 0], cells[:, 1]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seeds", default="0,1,2")
    parser.add_argument("--worlds", default="office,random")
    parser.add_argument("--variations", default="plain", help=f"or all: {', '.join(VARIATIONS)}".replace("%", "%%"))
    parser.add_argument("--particles", type=int, default=30)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    variations = list(VARIATIONS) if arguments.variations == "all" else arguments.variations.split(",")
    if unknown := set(variations) - set(VARIATIONS):
        parser.error(f"no variation {', '.join(sorted(unknown))}; there are {', '.join(VARIATIONS)}")
    rows: list[dict[str, object]] = []
    for name, variation in product(arguments.worlds.split(","), variations):
        for seed in arguments.seeds.split(","):
            rows.append(run(name, variation, int(seed), arguments.minutes, arguments.particles))
            if not arguments.json:
                if len(rows) == 1:
                    print(heading(list(rows[0])))
                print(line(rows[-1], list(rows[0])), flush=True)
    if arguments.json:
        print(json.dumps(rows))


if __name__ == "__main__":
    main()
