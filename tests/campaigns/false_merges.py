"""Ten thousand pairs of maps that must not merge, in blocks that several processes share and a later run takes up again.

.venv/bin/python -m tests.campaigns.false_merges                 10,000 pairs on two processes
.venv/bin/python -m tests.campaigns.false_merges --pairs 500     a sample
.venv/bin/python -m tests.campaigns.false_merges --seed 2        other pairs

Which pairs those are: `negative_pairs.py`; BENCH_DATA says where recordings lie.  Every block that is done is a line of
out/campaigns/false_merges-SEED-CODE.jsonl; the same command begins where it was stopped, and anew when the code or
the recordings are others.  Every accepted pair is printed; the exit code counts them.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import multiprocessing
import sys
import time
from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import cv2

from agent.merging.matching import match_maps
from tests.bench.tables import markdown
from tests.campaigns.negative_pairs import folders, negatives

REPO = Path(__file__).resolve().parents[2]
BLOCK = 250  # pairs
MAKERS = ("negative_pairs.py", "repeating_buildings.py")


def judged(seed: int, block: int) -> dict[str, Any]:
    """One block: how many of each kind, which merged, and the CPU of matching and of everything."""
    cv2.setNumThreads(1)
    started = time.process_time()
    tried: Counter[str] = Counter()
    spent: Counter[str] = Counter()
    merged = []
    for pair in negatives(seed, block, BLOCK):
        before = time.process_time()
        result = match_maps(pair.ours.snapshot, pair.theirs.snapshot)
        spent[pair.kind] += time.process_time() - before
        tried[pair.kind] += 1
        if result.accepted:
            numbers = {name: round(value, 2) for name, value in result.evidence.items()}
            merged.append({"kind": pair.kind, "ours": pair.ours.name, "theirs": pair.theirs.name, "evidence": numbers})
    return {"block": block, "tried": tried, "spent_s": spent, "merged": merged, "all_s": time.process_time() - started}


def code_hash() -> str:
    """Of what decides: the code of features and merging, and which recordings there are."""
    files = sorted([*REPO.glob("agent/features/*.py"), *REPO.glob("agent/merging/*.py"), *map(Path(__file__).with_name, MAKERS)])
    told = hashlib.sha256(b"".join(path.read_bytes() for path in files))
    told.update("".join(map(str, folders())).encode())
    return told.hexdigest()[:10]


def blocks_of(store: Path, wanted: int, seed: int, jobs: int) -> Iterator[dict[str, Any]]:
    """Results of the first blocks: those in the store, then the others as they are done."""
    done = [result for result in _stored(store) if result["block"] < wanted]
    yield from done
    left = sorted(set(range(wanted)) - {result["block"] for result in done})
    with multiprocessing.get_context("spawn").Pool(jobs) as pool, store.open("a") as log:
        for result in pool.imap_unordered(partial(judged, seed), left):
            print(json.dumps(result), file=log, flush=True)
            yield result


def _stored(store: Path) -> list[dict[str, Any]]:
    """Whole lines only: the last one may have been cut by a kill, and is then taken away."""
    whole = [line for line in store.read_text().splitlines(keepends=True) if line.endswith("\n")] if store.is_file() else []
    store.write_text("".join(whole))
    return [json.loads(line) for line in whole]


def figures(results: list[dict[str, Any]]) -> dict[str, Any]:
    """A row for each kind of pair and one for all, and what everything took."""
    tried, spent, merged = Counter[str](), Counter[str](), Counter[str]()
    for result in results:
        tried.update(result["tried"])
        spent.update(result["spent_s"])
        merged.update(pair["kind"] for pair in result["merged"])
    rows = [row(kind, tried[kind], merged[kind], spent[kind]) for kind in sorted(tried)]
    rows.append(row("all", tried.total(), merged.total(), sum(spent.values())))
    whole_s = sum(result["all_s"] for result in results)
    return {"rows": rows, "CPU s": round(whole_s), "CPU ms a pair": round(1e3 * whole_s / max(1, tried.total()))}


def row(kind: str, tried: int, merged: int, spent_s: float) -> dict[str, Any]:
    return {"negative pairs": kind, "tried": tried, "merged": merged, "CPU ms a match": round(1e3 * spent_s / max(1, tried))}


def table(told: dict[str, Any]) -> str:
    took = f"CPU {told['CPU s']} s, {told['CPU ms a pair']} ms a pair with making the maps and their features"
    return f"{markdown(told['rows'])}\n\n{took}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=10_000, help=f"in blocks of {BLOCK} (default 10,000)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=2, help="processes (default 2)")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    store = REPO / "out" / "campaigns" / f"false_merges-{args.seed}-{code_hash()}.jsonl"
    store.parent.mkdir(parents=True, exist_ok=True)
    wanted, started, results = -(-args.pairs // BLOCK), time.monotonic(), []
    for result in blocks_of(store, wanted, args.seed, args.jobs):
        results.append(result)
        for pair in result["merged"]:
            print(f"MERGED {pair['kind']}: {pair['ours']} with {pair['theirs']} {pair['evidence']}", file=sys.stderr)
        print(f"{len(results)}/{wanted} blocks, {time.monotonic() - started:.0f} s", file=sys.stderr, flush=True)
    told = figures(results)
    print(json.dumps(told) if args.json else table(told))
    return min(100, sum(len(result["merged"]) for result in results))


if __name__ == "__main__":
    sys.exit(main())
