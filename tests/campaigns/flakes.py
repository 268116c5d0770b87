"""C12, the flake hunt: the default tests again and again, in random order, with random inputs, beside a busy neighbour.

    .venv/bin/python -m tests.campaigns.flakes [--rounds 50] [--hogs 0] [--seed 1] [--kept FILE] [--json] [-- PYTEST ARGUMENTS]

Every test that failed in any round is listed with how often and why; what fails always is broken, what fails sometimes is a
flake, and both are our bugs.  `--hogs` processes do nothing but compute meanwhile.  With `--kept` every round is
written down in FILE when it ends: a hunt that was stopped goes on where it was, until there are as many rounds as asked for.
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
from dataclasses import asdict, dataclass
from pathlib import Path

from tests.bench.tables import markdown
from tests.harness.kept import keep, kept

ROOT = Path(__file__).resolve().parents[2]
REASON_CHARS = 160


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=50)
    parser.add_argument("--hogs", type=int, default=0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--kept", type=Path, metavar="FILE", help="where rounds are written down: the hunt may be stopped and gone on with"
    )
    parser.add_argument("--json", action="store_true")
    parser.add_argument("pytest", nargs="*", help="what to run instead of everything")
    args = parser.parse_args(argv)
    rounds = [Round(**record) for record in kept(args.kept)]
    with busy(args.hogs):
        while len(rounds) < args.rounds:
            rounds.append(one_round(random.Random(f"{args.seed}/{len(rounds)}").randrange(2**31), args.pytest))
            keep(args.kept, asdict(rounds[-1]))
            print(f"round {len(rounds)}: {json.dumps(asdict(rounds[-1]))}", file=sys.stderr, flush=True)
    print(json.dumps([asdict(each) for each in rounds], indent=1) if args.json else table(rounds))
    return 1 if any(each.failed for each in rounds) else 0


@dataclass(frozen=True)
class Round:
    """All tests once."""

    seed: int
    tests: int
    load: float
    minutes: float
    failed: dict[str, str]  # by test: the first words of why


def one_round(seed: int, words: list[str]) -> Round:
    """Every test that is chosen, in an order and with inputs of this seed."""
    started = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.xml"
        command = [sys.executable, "-m", "pytest", "-n", "2", "-p", "tests.harness.shuffled", f"--hypothesis-seed={seed}"]
        done = subprocess.run(
            [*command, f"--junitxml={report}", *words],
            cwd=ROOT,
            env={**os.environ, "MAPQUILT_SHUFFLE": str(seed)},
            capture_output=True,
            text=True,
            check=False,
        )
        cases = list(ET.parse(report).getroot().iter("testcase")) if report.is_file() else []
    failed = {
        f"{case.get('classname')}::{case.get('name')}": (outcome.get("message") or "")[:REASON_CHARS]
        for case in cases
        for outcome in (*case.findall("failure"), *case.findall("error"))
    }
    if not cases:
        failed["pytest itself"] = done.stdout[-REASON_CHARS:]
    return Round(seed, len(cases), round(os.getloadavg()[2], 1), round((time.monotonic() - started) / 60, 1), failed)


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


def table(rounds: list[Round]) -> str:
    failed = Counter(name for each in rounds for name in each.failed)
    reasons = {name: why for each in rounds for name, why in each.failed.items()}
    row = {
        "rounds": len(rounds),
        "tests run": sum(each.tests for each in rounds),
        "load": round(sum(each.load for each in rounds) / max(1, len(rounds)), 1),
        "minutes": round(sum(each.minutes for each in rounds), 1),
        "failed ever": len(failed),
    }
    return "\n".join([markdown([row]), *(f"- {name}: {n} times: {reasons[name]}" for name, n in failed.most_common())])


if __name__ == "__main__":
    raise SystemExit(main())
