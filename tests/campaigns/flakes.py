"""C12, the flake hunt: the default tests again and again, in random order, with random inputs, beside a busy neighbour.

    .venv/bin/python -m tests.campaigns.flakes [--rounds 50] [--hogs 0] [--seed 1] [--json] [-- PYTEST ARGUMENTS]

Every test that failed in any round is listed with how often and why; what fails always is broken, what fails sometimes is a
flake, and both are our bugs.  `--hogs` processes do nothing but compute meanwhile.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import multiprocessing
import os
import random
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from tests.bench.tables import markdown

ROOT = Path(__file__).resolve().parents[2]
REASON_CHARS = 160


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=50)
    parser.add_argument("--hogs", type=int, default=0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("pytest", nargs="*", help="what to run instead of everything")
    args = parser.parse_args(argv)
    rng = random.Random(args.seed)
    failed: Counter[str] = Counter()
    reasons: dict[str, str] = {}
    tests, started, loads = 0, time.monotonic(), []
    with busy(args.hogs):
        for number in range(args.rounds):
            seed = rng.randrange(2**31)
            count, failures = one_round(seed, args.pytest)
            tests += count
            loads.append(os.getloadavg()[0])
            failed.update(failures.keys())
            reasons |= failures
            print(f"round {number + 1}, seed {seed}: {count} tests, load {loads[-1]:.0f}, failed: {failures}", file=sys.stderr)
    figures = {
        "rounds": args.rounds,
        "tests run": tests,
        "load": round(sum(loads) / len(loads), 1),
        "minutes": round((time.monotonic() - started) / 60, 1),
        "failed ever": {name: [n, reasons[name]] for name, n in failed.most_common()},
    }
    print(json.dumps(figures, indent=1) if args.json else table(figures, failed, reasons))
    return 1 if failed or not tests else 0


def one_round(seed: int, words: list[str]) -> tuple[int, dict[str, str]]:
    """How many tests ran; those that failed, each with the first words of why."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.xml"
        command = [sys.executable, "-m", "pytest", "-n", "2", "-p", "tests.harness.shuffled", f"--hypothesis-seed={seed}"]
        subprocess.run(
            [*command, f"--junitxml={report}", *words],
            cwd=ROOT,
            env={**os.environ, "MAPQUILT_SHUFFLE": str(seed)},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            check=False,
        )
        cases = list(ET.parse(report).getroot().iter("testcase"))
    failures = {}
    for case in cases:
        for outcome in (*case.findall("failure"), *case.findall("error")):
            failures[f"{case.get('classname')}::{case.get('name')}"] = (outcome.get("message") or "")[:REASON_CHARS]
    return len(cases), failures


@contextlib.contextmanager
def busy(hogs: int) -> Iterator[None]:
    """Neighbours that take what they can get."""
    processes = [multiprocessing.Process(target=_compute, daemon=True) for _ in range(hogs)]
    for process in processes:
        process.start()
    try:
        yield
    finally:
        for process in processes:
            process.kill()


def _compute() -> None:
    while True:
        sum(range(100_000))


def table(figures: dict[str, object], failed: Counter[str], reasons: dict[str, str]) -> str:
    row = {name: figures[name] for name in ("rounds", "tests run", "load", "minutes")} | {"failed ever": len(failed)}
    return "\n".join([markdown([row]), *(f"- {name}: {n} times: {reasons[name]}" for name, n in failed.most_common())])


if __name__ == "__main__":
    raise SystemExit(main())
