"""What merging two maps costs, stage by stage: how it grows with the features and the size of the maps, and on recordings.

.venv/bin/python -m tests.bench.merge_cost                    tables, and the charts tests/bench/pictures/merge_cost_*.svg
.venv/bin/python -m tests.bench.merge_cost --kit-stride 4     more of the kit in BENCH_DATA
.venv/bin/python -m tests.bench.merge_cost --json

All figures are CPU milliseconds of one thread with the features of both maps at hand, except where a stage makes them.  Beside
the paper's method and an exhaustive search in one run: `tests.bench.paper_figures --fft`.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import cv2
import numpy as np

from agent.features.extraction import extract_features
from agent.features.paper import paper_features
from agent.features.snapshot import MapSnapshot
from agent.merging import matching
from agent.merging import search as funnel
from agent.merging.equations import FactorCounter
from agent.merging.matching import match_maps, verify_match
from agent.merging.paper import rotation_candidates, similar_features, translation_candidates
from agent.merging.search import FIRST_PASS, SECOND_PASS, search
from protocol.geometry import SE2
from tests.bench.features import cpu_ms, prepared
from tests.bench.line_chart import exponent, log_log_chart
from tests.bench.map_pairs import kit_pairs
from tests.bench.tables import markdown
from tests.harness.floorplans import office

PICTURES = Path(__file__).with_name("pictures")
ROOMS = (4, 8, 16, 32, 64, 128)
T_A, T_B = SE2(3.0, -2.0, 0.3), SE2(-10.0, 5.0, 2.1)
STAGES = {
    "rotations": (funnel, "rotation_candidates"),
    "corners": (funnel, "corner_candidates"),
    "signatures": (funnel, "signature_candidates"),
    "correlation": (funnel, "correlation_candidates"),
    "coarse score": (funnel, "_coarsely_best"),
    "both ways": (funnel, "_both_ways"),
    "refinement": (funnel, "refined"),
    "evidence": (matching, "weighed"),
    "mirror test": (matching, "is_mirror_image"),
    "covariance": (matching, "_covariance"),
}


def of_building(rooms: int) -> dict[str, Any]:
    """A drawn building of so many rooms: two maps of 10 cm cells with a half in common."""
    plan = office(7, rooms)
    ours = plan.mapped(T_A, 0.1, (-1, 0.75 * plan.width_m), noise_m=0.02, seed=1)
    theirs = plan.mapped(T_B, 0.1, (0.25 * plan.width_m, 1e4), noise_m=0.02, seed=2)
    a, b = MapSnapshot.of(ours), MapSnapshot.of(theirs)
    result = match_maps(a, b)
    assert result.accepted, f"{rooms} rooms: {result.reason}"
    pairs = similar_features(paper_features(ours), paper_features(theirs), 0.15)
    counter = FactorCounter.of(ours, theirs)
    return {
        "rooms": rooms,
        "cells": int(ours.cells.size),
        "features": len(a.features),
        "features_ms": cpu_ms(lambda: extract_features(ours)),
        "all_kept_ms": cpu_ms(lambda: prepared(ours)),
        **{f"{name}_ms": ms for name, ms in of_pair(a, b, result.T_ours_theirs).items()},
        "match_factor_ms": cpu_ms(lambda: counter.at(result.T_ours_theirs)),
        "paper_features_ms": cpu_ms(lambda: paper_features(ours)),
        "paper_vote_ms": cpu_ms(lambda: [list(translation_candidates(pairs, t)) for t in rotation_candidates(pairs, 1.0)]),
    }


def of_pair(a: MapSnapshot, b: MapSnapshot, T_a_b: SE2) -> dict[str, float]:
    """Matching two maps whose features are at hand."""
    return {
        "first_pass": cpu_ms(lambda: search(a, b, FIRST_PASS)),
        "second_pass": cpu_ms(lambda: search(a, b, SECOND_PASS)),
        "match": cpu_ms(lambda: match_maps(a, b)),
        "verify": cpu_ms(lambda: verify_match(a, b, T_a_b)),
    }


def of_recordings(stride: int) -> list[dict[str, Any]]:
    """Pairs of the kit that fit: median and worst by building."""
    by_log = defaultdict(list)
    for pair in kit_pairs("main", "pos", stride):
        a, b = MapSnapshot.of(pair.ours), MapSnapshot.of(pair.theirs)
        by_log[pair.name.split()[1]].append(of_pair(a, b, match_maps(a, b).T_ours_theirs or SE2.identity()))
    return [
        {"recording": log, "pairs": len(rows), **{f"{name} ms (worst)": _median_and_worst(rows, name) for name in rows[0]}}
        for log, rows in by_log.items()
    ]


def by_stage(stride: int) -> list[dict[str, Any]]:
    """Where the milliseconds of a match with cached features go, on average over pairs of the kit that fit."""
    spent: dict[str, float] = defaultdict(float)
    pairs = 0
    for pair in kit_pairs("main", "pos", stride):
        a, b = MapSnapshot.of(pair.ours), MapSnapshot.of(pair.theirs)
        match_maps(a, b)
        with _watched(spent):
            started = time.process_time()
            match_maps(a, b)
            spent["all"] += time.process_time() - started
        pairs += 1
    spent["the rest"] = 2 * spent["all"] - sum(spent.values())
    return [
        {"stage": name, "ms": round(1e3 * seconds / pairs, 2)} for name, seconds in sorted(spent.items(), key=lambda kv: -kv[1])
    ]


@contextmanager
def _watched(spent: dict[str, float]) -> Iterator[None]:
    """CPU by stage; what a stage calls is its own, so the mirror test's search is not counted twice."""
    inside: list[str] = []

    def watched(name: str, work: Callable[..., Any]) -> Callable[..., Any]:
        def run(*args: Any) -> Any:
            if inside:
                return work(*args)
            inside.append(name)
            started = time.process_time()
            try:
                return work(*args)
            finally:
                spent[inside.pop()] += time.process_time() - started

        return run

    patches = [mock.patch.object(room, name, watched(stage, getattr(room, name))) for stage, (room, name) in STAGES.items()]
    for patch in patches:
        patch.start()
    try:
        yield
    finally:
        for patch in patches:
            patch.stop()


def _median_and_worst(rows: list[dict[str, float]], name: str) -> str:
    values = [row[name] for row in rows]
    return f"{np.median(values):.1f} ({max(values):.1f})"


def draw(rows: list[dict[str, Any]]) -> None:
    """One chart over the number of features, one over the cells."""
    for column, label in (("features", "features of one map"), ("cells", "cells of one map")):
        series = {
            name.removesuffix("_ms").replace("_", " "): [(row[column], row[name]) for row in rows]
            for name in rows[0]
            if name.endswith("_ms")
        }
        series["linear, to compare"] = [(row[column], 5 * row[column] / rows[0][column]) for row in rows]
        chart = log_log_chart("CPU of each stage of merging", label, "ms", series)
        (PICTURES / f"merge_cost_{column}.svg").write_text(chart)


def exponents(rows: list[dict[str, Any]]) -> str:
    told = [
        f"{name.removesuffix('_ms')} n^{exponent([(row['features'], row[name]) for row in rows]):.2f}"
        for name in rows[0]
        if name.endswith("_ms")
    ]
    return "growth with the number of features n: " + ", ".join(told)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--kit-stride", type=int, default=8, metavar="N", help="every N-th fitting pair of the kit (default 8)")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    size, recordings, stages = [of_building(rooms) for rooms in ROOMS], of_recordings(args.kit_stride), by_stage(args.kit_stride)
    draw(size)
    if args.json:
        print(json.dumps({"growth": size, "recordings": recordings, "stages": stages}, indent=1))
    else:
        print("\n\n".join([markdown(size), exponents(size), *(markdown(rows) for rows in (recordings, stages) if rows)]))


if __name__ == "__main__":
    main()
