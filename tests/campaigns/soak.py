"""C9: robots that run for hours: does memory stay, do files and threads stay, does anything go wrong?

    .venv/bin/python -m tests.campaigns.soak [--robots 4] [--minutes 40] [--particles 8] [--trace] [--json]    simulated time
    .venv/bin/python -m tests.campaigns.soak --real [--robots 4] [--minutes 30] [--json]                       real processes

In simulated time whole robots (`tests/harness/rehearsal.py`) run as fast as this machine can, all in one process, on a network
in memory, in a hall that is soon known.  What grows while maps grow is no leak: the slope is taken from the moment on at which
nobody's map has grown by more than a hundredth for a minute.  `--trace` names the lines whose memory grew since then.
With --real they are processes on Zenoh in an office, their descriptors and threads are counted, too, and the first third is
warm-up.  Bars: the slope of resident memory (Theil-Sen) at most 1 MB per hour and robot, descriptors and threads constant, no
error logged.
"""

from __future__ import annotations

import argparse
import itertools
import logging
import os
import statistics
import sys
import time
import tracemalloc
from collections.abc import Sequence
from typing import Any

from agent.runtime.memory import give_back_memory, keep_memory_small
from hw.sim.catalogue import BASES, LIDARS
from hw.sim.robot import SimulatedRobot
from hw.sim.sight import Sight
from hw.sim.world import World, box, polygon
from tests.bench.tables import print_row
from tests.harness.fleet import Fleet
from tests.harness.golden import FIRST_S, READ_S, TURN_S, Run, rehearsal
from tests.harness.processes import open_files, resident_mb, threads
from tests.harness.rehearsal import Rehearsal, Wire

MAX_SLOPE_MB_PER_H = 1.0
WARM_UP = 1 / 3  # of the time
SAMPLE_S = 5.0
SETTLED_FOR_S, SETTLED_GROWTH = 60.0, 0.01
SPACING_M = 2.0
HALL = (
    box(0.0, 0.0, 12.0, 9.0),
    box(3.0, 2.5, 3.6, 4.7),
    box(8.2, 5.6, 9.6, 6.1),
    box(5.4, 7.2, 5.9, 9.0),
    polygon([(8.0, 0.0), (9.3, 0.0), (8.9, 2.1)]),
    polygon([(0.0, 6.0), (1.8, 6.4), (1.5, 7.0), (0.0, 6.9)]),
)

Samples = list[tuple[float, float]]  # seconds, megabytes


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, default=4)
    parser.add_argument("--minutes", type=float, default=40.0)
    parser.add_argument("--particles", type=int, default=8)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--trace", action="store_true", help="name the lines whose memory grew after the maps had settled")
    parser.add_argument("--real", action="store_true", help="processes in real time, instead of simulated time")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args(argv)
    figures = in_real_time(args) if args.real else in_simulated_time(args)
    print_row(figures, as_json=args.json)
    is_constant = figures.get("files drift", 0) <= 0 and figures.get("threads drift", 0) <= 0
    is_flat = figures["MB per hour and robot"] <= MAX_SLOPE_MB_PER_H
    return 0 if is_flat and is_constant and figures["errors"] == 0 else 1


def slope_per_hour(samples: Samples) -> float:
    """Theil-Sen: the median of the slopes between all pairs, blind to single jumps."""
    slopes = [(b[1] - a[1]) / (b[0] - a[0]) for a, b in itertools.combinations(thinned(samples), 2)]
    return 3600.0 * statistics.median(slopes) if slopes else float("nan")


def thinned(samples: Samples, most: int = 300) -> Samples:
    return samples[:: max(1, len(samples) // most)]


def after_warm_up(samples: Samples) -> Samples:
    return [(at_s, mb) for at_s, mb in samples if at_s >= WARM_UP * samples[-1][0]]


def row(mode: str, args: argparse.Namespace, slope: float, mb: Sequence[float], errors: int) -> dict[str, Any]:
    return {
        "time": mode,
        "robots": args.robots,
        "robot-hours": args.robots * args.minutes / 60,
        "MB per hour and robot": slope,
        "MB after warm-up": mb[0],
        "MB at the end": mb[-1],
        "errors": errors,
    }


# Simulated time.


class Errors(logging.Handler):
    """Counts what somebody must come for."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.count = 0

    def emit(self, record: logging.LogRecord) -> None:
        self.count += 1
        print(record.getMessage(), record.exc_info or "", file=sys.stderr)


def in_simulated_time(args: argparse.Namespace) -> dict[str, Any]:
    errors = Errors()
    logging.getLogger().addHandler(errors)
    keep_memory_small()
    devices, run = stage(args.robots, args.seed)
    wire = Wire()
    robots = {name: rehearsal(run, name, wire.exchange, args.particles) for name in run.robots}
    samples: Samples = []
    areas: Samples = []
    settled_s: float | None = None
    before: tracemalloc.Snapshot | None = None
    started_s = time.monotonic()
    for turn in range(round(60 * args.minutes / TURN_S)):
        at_s = turn * TURN_S
        one_turn(robots, devices, wire, FIRST_S + at_s)
        if turn % round(SAMPLE_S / TURN_S) == 0:
            give_back_memory()  # as the keeper does
            samples.append((at_s, resident_mb(os.getpid())))
            areas.append((at_s, known_m2(robots)))
            if settled_s is None and is_settled(areas):
                settled_s = at_s
                before = traced() if args.trace else None
        if turn % round(120 / TURN_S) == 0:
            told = f"{samples[-1][1]:.1f} MB, {areas[-1][1]:.1f} m2"
            print(f"{at_s / 60:.0f} min after {time.monotonic() - started_s:.0f} s: {told}", file=sys.stderr)
    if before is not None:
        for difference in tracemalloc.take_snapshot().compare_to(before, "lineno")[:15]:
            print(difference, file=sys.stderr)
    kept = [sample for sample in samples if settled_s is not None and sample[0] >= settled_s + SETTLED_FOR_S]
    slope = slope_per_hour(kept) / args.robots
    together = [len(robot.node.fleet.global_map.members) if robot.node.fleet.global_map else 0 for robot in robots.values()]
    failed = sum(report.errors for robot in robots.values() for report in robot.node.reports())
    figures = row("simulated", args, slope, [mb for _, mb in kept] or [float("nan")], errors.count + failed)
    more = {"settled after min": settled_s / 60 if settled_s is not None else float("nan"), "in one map": min(together)}
    return {**figures, **more, "times real": 60 * args.minutes / (time.monotonic() - started_s)}


def stage(n: int, seed: int) -> tuple[dict[tuple[str, str], Any], Run]:
    """The devices of `n` robots that drive about in one hall, and what a rehearsal needs to know of them."""
    world = World.of("hall", HALL)
    devices: dict[tuple[str, str], Any] = {}
    for i, start in enumerate(world.start_poses(n, seed, SPACING_M)):
        robot = SimulatedRobot(world, start, seed + i)
        robot.begin()
        devices[f"robot-{i + 1}", "lidar"] = LIDARS["ld06"][0](Sight(robot, seed=seed + i))
        devices[f"robot-{i + 1}", "wheels"] = BASES["wt1"].make(robot)
    urls = {(robot, device): "ld06:soak" if device == "lidar" else "wheels:soak" for robot, device in devices}
    return devices, Run(urls, [])


def known_m2(robots: dict[str, Rehearsal]) -> float:
    """What all local maps together know."""
    maps = [robot.node.map.newest for robot in robots.values()]
    return sum(estimate.grid.known_area_m2() for estimate in maps if estimate is not None)


def is_settled(areas: Samples) -> bool:
    """Whether the maps have not grown for a while."""
    now_s, area_m2 = areas[-1]
    earlier = [m2 for at_s, m2 in areas if at_s <= now_s - SETTLED_FOR_S]
    return bool(earlier) and earlier[-1] > 0.0 and area_m2 <= earlier[-1] * (1.0 + SETTLED_GROWTH)


def traced() -> tracemalloc.Snapshot:
    tracemalloc.start(3)
    return tracemalloc.take_snapshot()


def one_turn(robots: dict[str, Rehearsal], devices: dict[tuple[str, str], Any], wire: Wire, now_s: float) -> None:
    """A tenth of a second: wheels first, so that a scan finds the odometry of its last beam."""
    for part in range(round(TURN_S / READ_S)):
        read_s = now_s + part * READ_S
        for (name, device), source in sorted(devices.items(), reverse=True):
            if data := source.emit(read_s):
                robots[name].sense(device, read_s, data)
    for i, robot in enumerate(robots.values()):
        wire.now_s = now_s + TURN_S + i * TURN_S / 100
        robot.turn(wire.now_s)
        robot.maps.clear()  # what a rehearsal keeps to be compared
    wire.heard.clear()


# Real time.


def in_real_time(args: argparse.Namespace) -> dict[str, Any]:
    with Fleet() as fleet:
        acting = fleet.stage("office", robots=args.robots, seed=args.seed)
        for actor in acting.robots:
            fleet.start(actor, arguments=["--set", f"mapping.particles={args.particles}", "--no-state"])
        fleet.begin(acting)
        pids = {name: agent.process.pid for name, agent in fleet.agents.items()}
        samples: dict[str, Samples] = {name: [] for name in pids}
        counts: list[tuple[int, int]] = []  # files, threads, of all robots
        started_s = time.monotonic()
        while (at_s := time.monotonic() - started_s) < 60 * args.minutes:
            for name, pid in pids.items():
                samples[name].append((at_s, resident_mb(pid)))
            if at_s > WARM_UP * 60 * args.minutes:
                counts.append((sum(map(open_files, pids.values())), sum(map(threads, pids.values()))))
            time.sleep(SAMPLE_S)
        statuses = [fleet.status(name) for name in pids]
        logged = sum(agent.log_path.read_text(errors="replace").count(" ERROR ") for agent in fleet.agents.values())
    kept = {name: after_warm_up(one) for name, one in samples.items()}
    slopes = [slope_per_hour(one) for one in kept.values()]
    largest = max(kept.values(), key=lambda one: one[-1][1])
    failed = sum(worker["errors"] for status in statuses for worker in status.get("workers", []))
    figures = row("real", args, max(slopes), [mb for _, mb in largest], failed + logged)
    quarter = max(1, len(counts) // 4)  # the least of each end: a control connection comes and goes
    files, running = ([count[i] for count in counts] for i in (0, 1))
    return {
        **figures,
        "files drift": min(files[-quarter:]) - min(files[:quarter]),
        "threads drift": min(running[-quarter:]) - min(running[:quarter]),
        "in one map": min(len((status.get("global") or {}).get("members", [])) for status in statuses),
    }


if __name__ == "__main__":
    sys.exit(main())
