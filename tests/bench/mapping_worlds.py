"""Mapping where the truth is known: simulated robots explore simulated buildings for ten minutes.

    .venv/bin/python -m tests.bench.mapping_worlds [--minutes 10] [--seeds 0,1,2] [--worlds office,random] [--json]

A row per run: pose error at the end and at its worst, share of known cells that are right (a wall may lie one cell off),
CPU share of one core for odometry at 50 Hz and 360 beams at 10 Hz, and scans that were held back.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from agent.mapping.estimate import MapperStatus, ScanOutcome
from agent.mapping.mapper import Mapper
from agent.mapping.options import MappingOptions
from agent.runtime.own_loops import fit_in_own_map
from hw.readings import LaserScan, Odometry
from hw.sim.raycast import cast
from hw.sim.robot import SimulatedRobot
from hw.sim.world import World, open_world
from protocol.geometry import SE2
from protocol.grid import FREE, OCCUPIED, OccupancyGrid
from tests.bench.tables import markdown

BEAMS = 360
SCAN_HZ, ODOMETRY_HZ = 10.0, 50.0
MAX_RANGE_M = 12.0
NOISE_M = 0.01
BAR_M, BAR_DEG, BAR_CELLS, BAR_CPU = 0.05, 0.5, 0.99, 0.25


@dataclass
class Wheels:
    """Encoder counts to odometry: exact arcs."""

    robot: SimulatedRobot
    x_m: float = 0.0
    y_m: float = 0.0
    theta_rad: float = 0.0
    last: tuple[int, int] | None = None

    def sample(self, stamp_s: float) -> Odometry:
        options = self.robot.options
        ticks = self.robot.ticks_at(stamp_s)
        last = self.last or ticks
        metres = math.tau * options.wheel_radius_m / options.ticks_per_revolution
        left, right = (ticks[0] - last[0]) * metres, (ticks[1] - last[1]) * metres
        turn, way = (right - left) / options.track_m, (left + right) / 2
        self.x_m += way * math.cos(self.theta_rad + turn / 2)
        self.y_m += way * math.sin(self.theta_rad + turn / 2)
        self.theta_rad += turn
        self.last = ticks
        return Odometry(stamp_s, self.x_m, self.y_m, self.theta_rad)


def scan(robot: SimulatedRobot, stamp_s: float, rng: np.random.Generator, beams: int, scan_hz: float) -> LaserScan:
    """One revolution, each beam from where the robot was at its moment."""
    angles = np.arange(beams) * (math.tau / beams)
    offsets = np.arange(beams) / (beams * scan_hz)
    poses = robot.poses_at(stamp_s + offsets)
    ranges, _ = cast(robot.world.segments, poses[:, :2], poses[:, 2] + angles, MAX_RANGE_M)
    ranges = (ranges + rng.normal(0.0, NOISE_M, beams)).astype(np.float32)
    return LaserScan(
        stamp_s,
        ranges,
        angles.astype(np.float32),
        0.05,
        MAX_RANGE_M + 1.0,
        duration_s=1.0 / scan_hz,
        time_offsets_s=offsets.astype(np.float32),
    )


@dataclass(frozen=True, slots=True)
class Revolution:
    """What a robot hands on in one turn of its LIDAR, and the truth in the middle of it."""

    odometry: list[Odometry]  # up to the end of the turn
    scan: LaserScan
    T_world_robot: SE2


def world_of(name: str, seed: int) -> World:
    return open_world(f"{name}?seed={seed}" if name in ("office", "random", "outdoor") else name)


def explore(world: World, seed: int, minutes: float, beams: int = BEAMS, scan_hz: float = SCAN_HZ) -> Iterator[Revolution]:
    """A robot explores a world by itself; seeded."""
    robot = SimulatedRobot(world, world.start_poses(1, seed)[0], seed)
    wheels, rng, odometry_s = Wheels(robot), np.random.default_rng([3, seed]), 0.0
    robot.poses_at(np.array([0.0]))
    robot.begin()
    for k in range(int(minutes * 60 * scan_hz)):
        stamp_s = 0.1 + k / scan_hz
        revolution = scan(robot, stamp_s, rng, beams, scan_hz)
        samples = []
        while odometry_s <= stamp_s + 1.0 / scan_hz:
            samples.append(wheels.sample(odometry_s))
            odometry_s += 1.0 / ODOMETRY_HZ
        yield Revolution(samples, revolution, robot.pose_at(stamp_s + 0.5 / scan_hz))


def feed(mapper: Mapper, revolution: Revolution) -> tuple[ScanOutcome, float]:
    """One turn into the filter; what came of it and the CPU seconds it took."""
    started = time.process_time()
    for sample in revolution.odometry:
        mapper.add_odometry(sample)
    outcome = mapper.add_scan(revolution.scan)
    return outcome, time.process_time() - started


def run(name: str, seed: int, minutes: float, options: MappingOptions) -> dict[str, object]:
    world, mapper = world_of(name, seed), Mapper(options, seed, fit_in_own_map)
    errors, cpu_s, held, T_world_map = [], 0.0, 0, None
    for revolution in explore(world, seed, minutes):
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
    parser.add_argument("--particles", type=int, default=30)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    options = MappingOptions(particles=arguments.particles, matching_range_m=MAX_RANGE_M)
    rows = [
        run(name, int(seed), arguments.minutes, options)
        for name in arguments.worlds.split(",")
        for seed in arguments.seeds.split(",")
    ]
    if arguments.json:
        print(json.dumps(rows))
        return
    print(markdown(rows))


if __name__ == "__main__":
    main()
