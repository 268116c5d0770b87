"""C4 in simulation: thousands of seeded days of a fleet: loss, delay, partition, crash, restart, twins, wrong clocks.

    .venv/bin/python -m tests.campaigns.fleet_schedules [--schedules 10000] [--first 0] [--processes 2] [--json FILE]

Every schedule checks the invariants of `tests/fleet/schedules.py` while it runs and after its faults have stopped.  A failing
one is replayed with `--first SEED --schedules 1`.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
import time
import traceback
from collections import Counter
from pathlib import Path

import cv2

from tests.bench.tables import markdown
from tests.fleet.schedules import Outcome, run_schedule


def attempt(seed: int) -> tuple[int, Outcome | None, str]:
    """The outcome, or what went wrong."""
    try:
        return seed, run_schedule(seed), ""
    except Exception:  # every failure is a finding, whatever its type
        return seed, None, traceback.format_exc(limit=-3)


def quantile(values: list[float], share: float) -> float:
    return sorted(values)[min(int(share * len(values)), len(values) - 1)] if values else float("nan")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--schedules", type=int, default=10_000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--minutes", type=float, default=1e9, help="stop after this long and report what was done")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    started_s = time.monotonic()
    seeds = range(args.first, args.first + args.schedules)
    outcomes: list[Outcome] = []
    failures: list[tuple[int, str]] = []
    with multiprocessing.get_context("spawn").Pool(args.processes, initializer=cv2.setNumThreads, initargs=(1,)) as pool:
        for seed, outcome, trouble in pool.imap_unordered(attempt, seeds, chunksize=8):
            if outcome is not None:
                outcomes.append(outcome)
            else:
                failures.append((seed, trouble))
                print(f"seed {seed}:\n{trouble}", file=sys.stderr)
            if time.monotonic() - started_s > 60.0 * args.minutes:
                pool.terminate()
                break
    settled = [outcome.converged_s for outcome in outcomes]
    faults = Counter(fault for outcome in outcomes for fault in outcome.faults)
    figures = {
        "schedules": len(outcomes) + len(failures),
        "failed": len(failures),
        "failed_seeds": sorted(seed for seed, _ in failures)[:100],
        "fault_episodes": sum(faults.values()),
        "faults": dict(sorted(faults.items())),
        "wrong_edges": sum(outcome.wrong_edges for outcome in outcomes),
        "largest_group": max((outcome.connected for outcome in outcomes), default=0),
        "converged_s": {"p50": quantile(settled, 0.5), "p90": quantile(settled, 0.9), "p99": quantile(settled, 0.99)}
        | {"max": max(settled, default=float("nan"))},
        "wall_s": round(time.monotonic() - started_s, 1),
    }
    if args.json:
        args.json.parent.mkdir(parents=True, exist_ok=True)
        args.json.write_text(json.dumps(figures, indent=1) + "\n")
    s = figures["converged_s"]
    row = {
        "schedules": figures["schedules"],
        "fault episodes": figures["fault_episodes"],
        "invariants broken": len(failures),
        "wrong edges": figures["wrong_edges"],
        "converged after calm p50 / p90 / p99 / max": f"{s['p50']:.1f} / {s['p90']:.1f} / {s['p99']:.1f} / {s['max']:.1f} s",
    }
    print(markdown([row]))
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
