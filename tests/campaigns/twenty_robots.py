"""Twenty real robot processes in one simulated building: do all of them end up in one map, and what does it cost?

    .venv/bin/python -m tests.campaigns.twenty_robots [--robots 20] [--minutes 8] [--json]

Bars (RELIABILITY.md, C11): all merged into one global map with one digest, at most 120 MB resident each.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from typing import Any

from agent.commands.children import niceness
from tests.bench.tables import print_row
from tests.harness.fleet import Fleet
from tests.harness.processes import own_share_mb, resident_mb

MAX_RSS_MB = 120.0


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, default=20)
    parser.add_argument("--minutes", type=float, default=8.0)
    parser.add_argument("--particles", type=int, default=10, help="few, since all share this machine's cores")
    parser.add_argument("--world", default="office")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args(argv)
    figures = campaign(args)
    print_row(figures, as_json=args.json)
    return 0 if figures["one map"] and figures["largest RSS MB"] <= MAX_RSS_MB else 1


def campaign(args: argparse.Namespace) -> dict[str, Any]:
    with Fleet(niceness(args.robots)) as fleet:
        stage = fleet.stage(args.world, robots=args.robots, seed=args.seed)
        for actor in stage.robots:
            fleet.start(actor, arguments=["--set", f"mapping.particles={args.particles}", "--no-state"])
            print(f"up: {actor.name}", file=sys.stderr)
        fleet.begin(stage)
        started = time.monotonic()
        names, merged_s, most, rss_mb = [actor.name for actor in stage.robots], None, 0, 0.0
        while merged_s is None and time.monotonic() - started < 60 * args.minutes:
            held = [len(fleet.members(name)) for name in names]
            members = max(held)
            rss_mb = max(rss_mb, *(resident_mb(fleet.agents[name].process.pid) for name in names))
            if members > most:
                most = members
                print(f"{time.monotonic() - started:5.0f} s: {most} robots in one map, {rss_mb:.0f} MB", file=sys.stderr)
            if min(held) == args.robots:  # maps that grow travel late on few cores: some may hold a map of fewer to the end
                merged_s = time.monotonic() - started
            time.sleep(1.0)
        agreed_s = fleet.seconds_to_one_map_at_rest(names)
        digests = Counter(fleet.global_digest(name) for name in names)
        rss_mb = max(rss_mb, *(resident_mb(fleet.agents[name].process.pid) for name in names))
        together = max((count for digest, count in digests.items() if digest is not None), default=0)
        total_mb = sum(own_share_mb(fleet.agents[name].process.pid) for name in names)
        statuses = [fleet.status(name) for name in names]
        for error in sorted(
            {f"{w['name']}: {w['error']}" for status in statuses for w in status.get("workers", []) if w["error"]}
        ):
            print(error, file=sys.stderr)
    mappings = [status["mapping"] for status in statuses if status]
    return {
        "robots": args.robots,
        "in one map": most,
        "one map": agreed_s is not None,
        "seconds until each holds all": merged_s,
        "robots with one digest, mapping paused": together,
        "seconds to one digest everywhere, mapping paused": agreed_s,
        "largest RSS MB": rss_mb,
        "all together MB (PSS)": total_mb,
        "scans": sum(m["scans"] for m in mappings),
        "scans lost": sum(m["scans_lost"] for m in mappings),
        "worker errors": sum(w["errors"] for status in statuses if status for w in status["workers"]),
        "largest inbox drops": max((status["network"]["inbox_dropped"] for status in statuses if status), default=0),
    }


if __name__ == "__main__":
    sys.exit(main())
