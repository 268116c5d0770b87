"""How features bear noise, and how the time of every stage of merging grows with the number of features and the size of the map.

.venv/bin/python -m tests.bench.features            tables, and out/bench/features_*.svg
.venv/bin/python -m tests.bench.features --json
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from agent.features.extraction import extract_features, feature_map
from agent.features.field import MatchField
from agent.features.lines import wall_lines
from agent.features.paper import paper_features
from agent.features.signatures import MAX_TARGETS
from agent.features.snapshot import MapSnapshot
from agent.features.wall_points import wall_points
from agent.features.working import WorkingGrid
from agent.merging.equations import FactorCounter
from agent.merging.matched_features import matched_features
from agent.merging.matching import match_maps, verify_match
from agent.merging.paper import rotation_candidates, similar_features, translation_candidates
from agent.merging.search import FIRST_PASS, search
from protocol.features import FeatureMap
from protocol.fields import FEATURES
from protocol.geometry import SE2, wrap_angle
from tests.bench.line_chart import exponent, log_log_chart
from tests.bench.map_pairs import kit_pairs
from tests.bench.tables import markdown
from tests.harness.floorplans import office

OUT = Path(__file__).resolve().parents[2] / "out" / "bench"
KINDS = ("lines", "circles", "arcs", "curves")
NOISE_M = (0.0, 0.02, 0.04, 0.06, 0.1)
ROOMS = (4, 8, 16, 32, 64)
T_A, T_B = SE2(3.0, -2.0, 0.3), SE2(-10.0, 5.0, 2.1)


def against_noise(seeds: range) -> list[dict[str, Any]]:
    """The same buildings drawn by two robots whose walls scatter; repeatability is counted at the true transform."""
    rows = []
    for noise_m in NOISE_M:
        pairs = []
        for seed in seeds:
            plan = office(seed)
            ours = extract_features(plan.mapped(T_A, 0.05, noise_m=noise_m, seed=seed))
            theirs = extract_features(plan.mapped(T_B, 0.05, noise_m=noise_m, seed=100 + seed))
            pairs.append((ours, theirs))
        rows.append({"noise_cm": round(100 * noise_m), **_repeated(pairs)})
    return rows


def _repeated(pairs: list[tuple[FeatureMap, FeatureMap]]) -> dict[str, Any]:
    T = T_A @ T_B.inverse()
    found: dict[str, list[float]] = {kind: [] for kind in KINDS}
    counts: dict[str, list[int]] = {kind: [] for kind in found}
    turn, across = [], []
    for ours, theirs in pairs:
        same = matched_features(ours, theirs, T)
        for kind, shares in found.items():
            n = min(len(getattr(ours, kind)), len(getattr(theirs, kind)))
            counts[kind].append(len(getattr(ours, kind)))
            if n:
                shares.append(len(getattr(same, kind)) / n)
        a, b = ours.lines[same.lines[:, 0]], theirs.lines[same.lines[:, 1]]
        turn += [abs(wrap_angle(float(d))) for d in b[:, 2] + T.theta_rad - a[:, 2]]
        normal = np.stack([np.cos(a[:, 2]), np.sin(a[:, 2])], axis=1)
        across += np.abs(((T.apply(b[:, :2]) - a[:, :2]) * normal).sum(axis=1)).tolist()
    return {
        **{f"{kind}": round(float(np.mean(counts[kind])), 1) for kind in found},
        **{f"{kind}_again": round(float(np.mean(values)), 3) if values else None for kind, values in found.items()},
        "line_deg": round(math.degrees(float(np.median(turn))), 3),
        "line_cm": round(100 * float(np.median(across)), 2),
    }


def against_size() -> list[dict[str, Any]]:
    """CPU of every stage on buildings of more and more rooms, two maps of 10 cm cells with a half in common."""
    return [_stages(rooms) for rooms in ROOMS]


def _stages(rooms: int) -> dict[str, Any]:
    plan = office(7, rooms)
    ours = plan.mapped(T_A, 0.1, (-1, 0.75 * plan.width_m))
    theirs = plan.mapped(T_B, 0.1, (0.25 * plan.width_m, 1e4))
    working = WorkingGrid.of(ours)
    walls = wall_points(working)
    lines = wall_lines(walls, working.resolution_m)
    mine, yours = paper_features(ours), paper_features(theirs)
    pairs = similar_features(mine, yours, 0.15)
    ours_kept, theirs_kept = MapSnapshot.of(ours), MapSnapshot.of(theirs)
    result = match_maps(ours_kept, theirs_kept)
    assert result.accepted, f"{rooms} rooms: {result.reason}"
    T = result.T_ours_theirs
    assert T is not None
    counter = FactorCounter.of(ours, theirs)
    return {
        "rooms": rooms,
        "cells": int(ours.cells.size),
        "features": len(extract_features(ours)),
        "paper_features": len(mine),
        "wall_points_ms": _ms(lambda: wall_points(working)),
        "lines_ms": _ms(lambda: wall_lines(walls, working.resolution_m)),
        "round_and_curves_ms": _ms(lambda: feature_map(working, walls, lines, ours.origin)),
        "field_ms": _ms(lambda: MatchField.of(working, walls)),
        "signatures_ms": _ms(lambda: ours_kept._signatures(MAX_TARGETS)),
        "first_pass_ms": _ms(lambda: search(ours_kept, theirs_kept, FIRST_PASS)),
        "match_ms": _ms(lambda: match_maps(ours_kept, theirs_kept)),
        "verify_ms": _ms(lambda: verify_match(ours_kept, theirs_kept, T)),
        "match_factor_ms": _ms(lambda: counter.at(T)),
        "paper_features_ms": _ms(lambda: paper_features(ours)),
        "paper_vote_ms": _ms(lambda: [list(translation_candidates(pairs, t)) for t in rotation_candidates(pairs, 1.0)]),
    }


def of_recordings() -> list[dict[str, Any]]:
    """Features of the kit's maps, the median of each building: how many, how many bytes on the wire, CPU."""
    by_log: dict[str, list[list[float]]] = {}
    for pair in kit_pairs("main", "pos", stride=3):
        started = time.process_time()
        features = extract_features(pair.ours)
        cpu_ms = (time.process_time() - started) * 1e3
        counts = [len(getattr(features, kind)) for kind in KINDS]
        row = [*counts, _wire_bytes(FeatureMap(lines=features.lines)), _wire_bytes(features), cpu_ms]
        by_log.setdefault(pair.name.split()[1], []).append(row)
    names = [*KINDS, "line_bytes", "all_bytes", "cpu_ms"]
    return [
        {"recording": log, **dict(zip(names, np.round(np.median(rows, axis=0), 1).tolist(), strict=True))}
        for log, rows in by_log.items()
    ]


def _wire_bytes(features: FeatureMap) -> int:
    return len(FEATURES.pack(features)[1])


def _ms(work: Callable[[], object]) -> float:
    """Median CPU of five runs after a first one."""
    work()
    times = []
    for _ in range(5):
        started = time.process_time()
        work()
        times.append((time.process_time() - started) * 1e3)
    return round(max(0.01, float(np.median(times))), 2)


def as_markdown(*of: list[dict[str, Any]]) -> str:
    size = of[1]
    tables = [
        markdown([{name: "-" if value is None else str(value) for name, value in row.items()} for row in rows])
        for rows in of
        if rows
    ]
    growth = [
        f"{name} n^{exponent([(row['features'], row[name]) for row in size]):.2f}" for name in size[0] if name.endswith("_ms")
    ]
    return "\n\n".join([*tables, "growth with the number of features n: " + ", ".join(growth)])


def draw(size: list[dict[str, Any]]) -> list[Path]:
    """One chart over the number of features, one over the cells."""
    OUT.mkdir(parents=True, exist_ok=True)
    written = []
    for column, label in (("features", "features of one map"), ("cells", "cells of one map")):
        series = {
            name.removesuffix("_ms"): [(row[column], row[name]) for row in size] for name in size[0] if name.endswith("_ms")
        }
        path = OUT / f"features_{column}.svg"
        path.write_text(log_log_chart("CPU of each stage of merging", label, "ms", series))
        written.append(path)
    return written


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--seeds", type=int, default=10, help="buildings per noise level (default 10)")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    noise, size, recordings = against_noise(range(args.seeds)), against_size(), of_recordings()
    charts = draw(size)
    if args.json:
        print(json.dumps({"noise": noise, "size": size, "recordings": recordings}, indent=1))
    else:
        print(as_markdown(noise, size, recordings))
        print("\n" + "\n".join(f"chart: {path}" for path in charts))


if __name__ == "__main__":
    main()
