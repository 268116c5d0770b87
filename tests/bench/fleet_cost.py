"""What one more peer costs a robot, and how old its peers' maps are: real processes, over Zenoh, one building.

    .venv/bin/python -m tests.bench.fleet_cost [--sizes 1 2 4 8] [--seconds 30] [--json]

Once all are in one map, each robot's CPU, its mapping time a scan and its memory are watched while they explore on.  Then mapping
is paused, again and again: until the last robot holds the last global map is the whole way from a robot's own grid over its
feature map, the hint, the pull and the verdict to the map that all compose, and the last edge that is renewed on the last maps.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from collections.abc import Sequence
from typing import Any

from tests.bench.tables import print_rows
from tests.harness.fleet import Fleet
from tests.harness.processes import cpu_s, peak_mb, resident_mb

MEET_WITHIN_S = 120.0
ALONE_SCANS = 200
EXPLORE_ON_S = 4.0  # between two pauses
SETTLE_S, LOOK_EVERY_S = 12.0, 0.1  # of a pause


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=[1, 2, 4, 8])
    parser.add_argument("--seconds", type=float, default=30.0, help="watched, once all are in one map")
    parser.add_argument("--pauses", type=int, default=5)
    parser.add_argument("--world", default="office")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    rows = [measure(size, args) for size in args.sizes]
    print_rows(rows, as_json=args.json)


def measure(robots: int, args: argparse.Namespace) -> dict[str, object]:
    """One fleet, from its meeting to its last pause."""
    with Fleet() as fleet:
        stage = fleet.stage(args.world, robots=robots, seed=args.seed)
        for actor in stage.robots:
            fleet.start(actor, arguments=["--no-state"])
        fleet.begin(stage)
        names = list(fleet.agents)
        met_s = fleet.until(lambda: all_met(fleet, names), MEET_WITHIN_S, "one map of all")
        watched = watch(fleet, args.seconds)
        pauses = args.pauses if robots > 1 else 0
        delays_s = [delay for _ in range(pauses) if (delay := one_pause(fleet, names)) is not None]
        return {
            "robots": robots,
            "in one map after, s": met_s,
            **watched,
            "at rest after, s": statistics.median(delays_s) if delays_s else None,
            "at worst": max(delays_s, default=None),
            "pauses in time": f"{len(delays_s)} of {pauses}",
            "load": os.getloadavg()[0],
        }


def all_met(fleet: Fleet, names: Sequence[str]) -> bool:
    """Every robot holds a map of all; one alone only has to have been mapping for a while."""
    if len(names) == 1:
        return int(fleet.status(names[0])["mapping"]["scans"]) > ALONE_SCANS
    return all(len(fleet.members(name)) == len(names) for name in names)


def watch(fleet: Fleet, seconds: float) -> dict[str, object]:
    """Means over the robots while they explore on."""
    before, begun_s = [counters(fleet, name) for name in fleet.agents], time.monotonic()
    time.sleep(seconds)
    after, wall_s = [counters(fleet, name) for name in fleet.agents], time.monotonic() - begun_s
    spent = [{key: b[key] - a[key] for key in a} for a, b in zip(before, after, strict=True)]
    pids = [agent.process.pid for agent in fleet.agents.values()]
    return {
        "CPU of a core each": statistics.fmean(s["cpu_s"] for s in spent) / wall_s,
        "mapping ms a scan": statistics.fmean(s["mapping_ms"] / max(1.0, s["scans"]) for s in spent),
        "scans lost": sum(s["lost"] for s in spent),
        "RSS MB": statistics.fmean(map(resident_mb, pids)),
        "peak MB": max(map(peak_mb, pids)),
    }


def counters(fleet: Fleet, robot: str) -> dict[str, float]:
    mapping: dict[str, Any] = fleet.status(robot)["mapping"]
    return {
        "cpu_s": cpu_s(fleet.agents[robot].process.pid),
        "mapping_ms": mapping["cpu_ms_per_scan"] * mapping["scans"],
        "scans": mapping["scans"],
        "lost": mapping["scans_lost"],
    }


def one_pause(fleet: Fleet, names: Sequence[str]) -> float | None:
    """From standing still to the last global map that anybody had to make anew; None: they do not end with one and the same."""
    time.sleep(EXPLORE_ON_S)
    for name in names:
        fleet.agents[name].ask("pause")
    begun_s, seen = time.monotonic(), []
    while (now_s := time.monotonic() - begun_s) < SETTLE_S:
        seen.append((now_s, {fleet.global_digest(name) for name in names}))
        time.sleep(LOOK_EVERY_S)
    for name in names:
        fleet.agents[name].ask("resume")
    last = seen[-1][1]
    return max((now_s for now_s, digests in seen if digests != last), default=0.0) if len(last) == 1 else None


if __name__ == "__main__":
    main()
