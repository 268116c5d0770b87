"""C4 in simulation: thousands of seeded days of a fleet: loss, delay, partition, crash, restart, twins, wrong clocks.

    .venv/bin/python -m tests.campaigns.fleet_schedules [--schedules 10000] [--first 0] [--kept FILE] [--json FILE] [--gone]

Every schedule checks the invariants of `tests/fleet/schedules.py` while it runs and after its faults have stopped.  A failing
one is replayed with `--first SEED --schedules 1`.  With `--kept FILE` every outcome is written down as it comes, and the same
command goes on where it was stopped: start another file for other code.  With `--gone` they are days on which a robot dies for
good and another comes late (`tests/fleet/departures.py`).
"""

from __future__ import annotations

import argparse
import functools
import multiprocessing
import sys
import time
import traceback
from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2

from tests.bench.tables import markdown, write_json
from tests.fleet.departures import run_departure
from tests.fleet.schedules import run_schedule
from tests.harness.kept import Record, keep, kept
from tests.harness.processes import percentile

BAR_S = 5.0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--schedules", type=int, default=10_000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--minutes", type=float, default=1e9, help="stop after this long and report what was done")
    parser.add_argument("--kept", type=Path, help="append every outcome to this file; those in it are not run again")
    parser.add_argument("--gone", action="store_true", help="a robot dies for good, another comes late")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    started_s = time.monotonic()
    records = run(args, range(args.first, args.first + args.schedules))
    figures = {**summary(records), "wall_s": round(time.monotonic() - started_s, 1)}
    write_json(args.json, figures)
    print(markdown([row(figures)]))
    return 1 if figures["failed"] or figures["converged_s"]["p99"] > BAR_S else 0


def attempt(seed: int, *, is_gone: bool) -> Record:
    """An `Outcome`, or the seed and what went wrong."""
    try:
        return asdict(run_departure(seed) if is_gone else run_schedule(seed))
    except Exception:  # every failure is a finding, whatever its type
        return {"seed": seed, "trouble": traceback.format_exc(limit=-3)}


def run(args: argparse.Namespace, seeds: Iterable[int]) -> list[Record]:
    """One record a seed: those that are kept, and new ones as long as there is time."""
    records = [record for record in kept(args.kept) if record["seed"] in seeds]
    known, started_s = {record["seed"] for record in records}, time.monotonic()
    missing = [seed for seed in seeds if seed not in known]
    with multiprocessing.get_context("spawn").Pool(args.processes, initializer=cv2.setNumThreads, initargs=(1,)) as pool:
        for record in pool.imap_unordered(functools.partial(attempt, is_gone=args.gone), missing, chunksize=8):
            records.append(record)
            keep(args.kept, record)
            if "trouble" in record:
                print(f"seed {record['seed']}:\n{record['trouble']}", file=sys.stderr)
            if time.monotonic() - started_s > 60.0 * args.minutes:
                pool.terminate()
                break
    return records


def summary(records: list[Record]) -> dict[str, Any]:
    good = [record for record in records if "trouble" not in record]
    failed = sorted(record["seed"] for record in records if "trouble" in record)
    settled = sorted(record["converged_s"] for record in good) or [float("nan")]
    faults = Counter(fault for record in good for fault in record["faults"])
    return {
        "schedules": len(records),
        "failed": len(failed),
        "failed_seeds": failed[:100],
        "slowest_seeds": [record["seed"] for record in sorted(good, key=lambda record: -record["converged_s"])[:10]],
        "fault_episodes": sum(faults.values()),
        "faults": dict(sorted(faults.items())),
        "wrong_edges": sum(record["wrong_edges"] for record in good),
        "kept": sum(record.get("is_kept", False) for record in good),
        "largest_group": max((record["connected"] for record in good), default=0),
        "converged_s": {f"p{round(100 * share)}": percentile(settled, share) for share in (0.5, 0.9, 0.99)}
        | {"max": settled[-1]},
    }


def row(figures: dict[str, Any]) -> dict[str, Any]:
    s = figures["converged_s"]
    return {
        "schedules": figures["schedules"],
        "fault episodes": figures["fault_episodes"],
        "invariants broken": figures["failed"],
        "wrong edges": figures["wrong_edges"],
        **({"with the map of the robot that is gone": figures["kept"]} if figures["kept"] else {}),
        "converged after calm p50 / p90 / p99 / max": f"{s['p50']:.1f} / {s['p90']:.1f} / {s['p99']:.1f} / {s['max']:.1f} s",
    }


if __name__ == "__main__":
    sys.exit(main())
