"""Figures of the paper's own kind (agreement, disagreement, match factor, candidates, time), its method beside ours.

.venv/bin/python -m tests.bench.paper_figures            simulated pairs, and pairs of the recordings when the kit is built
.venv/bin/python -m tests.bench.paper_figures --json     the same rows as JSON
.venv/bin/python -m tests.bench.paper_figures --fft      the kit's exhaustive search by Fourier transform beside them

The last column of the summary is CPU as a multiple of ours on the same pairs in the same run, features included.
"""

from __future__ import annotations

import argparse
import importlib
import json
import math
import sys
import time
from collections.abc import Iterable
from itertools import chain
from typing import Any

import cv2
import numpy as np

from agent.features.paper import paper_features
from agent.features.snapshot import MapSnapshot
from agent.merging.matching import match_maps
from agent.merging.result import MatchOptions, MatchStatus, MergeResult
from protocol.geometry import SE2
from tests.bench.map_pairs import MapPair, kit_pairs, simulated_pairs
from tests.bench.recordings import SHARED
from tests.bench.tables import markdown

FFT = "fft, exhaustive"
METHODS = ("paper", "paper-guarded", FFT, "hybrid")
WORLDS = ["office?seed=1", "office?seed=2", "office?seed=3", "random?seed=1", "random?seed=2", "outdoor?seed=1"]


def measured(pair: MapPair, method: str) -> dict[str, Any]:
    started = time.process_time()
    result = exhaustive(pair) if method == FFT else hybrid_or_paper(pair, method)
    cpu_ms = (time.process_time() - started) * 1e3
    T = result.T_ours_theirs
    is_right = T is not None and pair.is_right(T)
    metres, radians = pair.errors(T) if T is not None and is_right else (math.nan, math.nan)
    return {
        "pair": pair.name,
        "should_merge": pair.truth is not None,
        "method": method,
        "features": [len(paper_features(pair.ours)), len(paper_features(pair.theirs))],
        "candidates": result.candidates_tried,
        "agree": result.factor.agree,
        "disagree": result.factor.disagree,
        "match_factor": round(result.factor.value, 4),
        "verdict": str(result.status),
        "is_right": is_right,
        "error_cm": None if math.isnan(metres) else round(100 * metres, 1),
        "error_deg": None if math.isnan(radians) else round(math.degrees(radians), 2),
        "cpu_ms": round(cpu_ms, 1),
    }


def hybrid_or_paper(pair: MapPair, method: str) -> MergeResult:
    return match_maps(MapSnapshot.of(pair.ours), MapSnapshot.of(pair.theirs), MatchOptions(method=method))


def exhaustive(pair: MapPair) -> MergeResult:
    """The kit's baseline; it tells neither match factor nor candidates."""
    if str(SHARED) not in sys.path:
        sys.path.append(str(SHARED))
    oracle, se2 = (importlib.import_module(f"bench.{name}") for name in ("adapters.fft_oracle", "se2"))
    accepted, T, score, _ = oracle.FftOracle()(pair.ours.cells, pair.theirs.cells, pair.ours.resolution_m)
    T_ours_theirs = pair.ours.origin @ SE2(*se2.params(T)) @ pair.theirs.origin.inverse()
    return MergeResult(MatchStatus.MERGED if accepted else MatchStatus.NO, T_ours_theirs, score=float(score))


def as_markdown(rows: list[dict[str, Any]]) -> str:
    return markdown(
        [
            {
                "pair": r["pair"],
                "features": f"{r['features'][0]}, {r['features'][1]}",
                "method": r["method"],
                "candidates": r["candidates"],
                "agr": r["agree"],
                "dis": r["disagree"],
                "MF": f"{r['match_factor']:.3f}",
                "verdict": r["verdict"],
                "right?": judged(r),
                "error cm / deg": "-" if r["error_cm"] is None else f"{r['error_cm']} / {r['error_deg']}",
                "CPU ms": f"{r['cpu_ms']:.0f}",
            }
            for r in rows
        ]
    )


def judged(row: dict[str, Any]) -> str:
    if row["verdict"] == "merged":
        return "right" if row["is_right"] else "**WRONG**"
    return "missed" if row["should_merge"] else "right"


def summary(rows: list[dict[str, Any]]) -> str:
    told = []
    ours_ms = {r["pair"]: r["cpu_ms"] for r in rows if r["method"] == "hybrid"}
    for method in METHODS:
        mine = [r for r in rows if r["method"] == method]
        if not mine:
            continue
        fit, unfit = [r for r in mine if r["should_merge"]], [r for r in mine if not r["should_merge"]]
        right, wrong = (sum(judged(r) == word for r in fit) for word in ("right", "**WRONG**"))
        cpu, times_ours = [r["cpu_ms"] for r in mine], [r["cpu_ms"] / ours_ms[r["pair"]] for r in mine]
        told.append(
            {
                "method": method,
                "fitting pairs: right / wrong / not merged": f"{right} / {wrong} / {len(fit) - right - wrong} of {len(fit)}",
                "strangers merged": f"{sum(r['verdict'] == 'merged' for r in unfit)} of {len(unfit)}",
                "CPU ms median (slowest tenth)": f"{np.median(cpu):.0f} ({np.percentile(cpu, 90):.0f})",
                "times ours": f"{np.median(times_ours):.1f}",
            }
        )
    return markdown(told)


def all_pairs(kit_stride: int) -> Iterable[MapPair]:
    simulated = chain(simulated_pairs(WORLDS, 0.05), simulated_pairs(WORLDS[:2], 0.2))
    recorded = chain(
        kit_pairs("main", "pos", kit_stride), kit_pairs("res20", "pos", 2 * kit_stride), kit_pairs("main", "neg", kit_stride)
    )
    return chain(simulated, recorded)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--kit-stride", type=int, default=6, help="every N-th pair of the kit (default 6)")
    parser.add_argument("--fft", action="store_true", help="also the exhaustive search of ../shared/bench: seconds a pair")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    methods = [method for method in METHODS if args.fft or method != FFT]
    rows = [measured(pair, method) for pair in all_pairs(args.kit_stride) for method in methods]
    print(json.dumps(rows, indent=1) if args.json else f"{as_markdown(rows)}\n\n{summary(rows)}")


if __name__ == "__main__":
    main()
