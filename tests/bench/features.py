"""How features bear noise, and what those of the recordings' maps are: how many, how many bytes, how much CPU.

.venv/bin/python -m tests.bench.features                    tables; the second needs the kit in BENCH_DATA
.venv/bin/python -m tests.bench.features --kit-stride 1     every fitting pair of the kit
.venv/bin/python -m tests.bench.features --json

CPU is that of one raw map: its feature map alone, and with all that matching keeps of a map as well (field, corners, directions,
signatures); the median and the worst of the maps.  How both grow: `tests.bench.merge_cost`.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

from agent.features.extraction import extract_features
from agent.features.snapshot import MapSnapshot
from agent.merging.matched_features import matched_features
from protocol.features import FeatureMap
from protocol.geometry import SE2, wrap_angle
from protocol.grid import OccupancyGrid
from protocol.map_fields import FEATURES
from tests.bench.map_pairs import kit_pairs
from tests.bench.tables import markdown
from tests.harness.floorplans import office

KINDS = ("lines", "circles", "arcs", "curves")
NOISE_M = (0.0, 0.02, 0.04, 0.06, 0.1)
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


def of_recordings(stride: int) -> list[dict[str, Any]]:
    """Features of both maps of the kit's fitting pairs, by building and resolution."""
    by_log: dict[str, list[list[float]]] = {}
    for pair in kit_pairs("main", "pos", stride):
        _, log, resolution = pair.name.split()
        for grid in (pair.ours, pair.theirs):
            features = extract_features(grid)
            counts = [len(getattr(features, kind)) for kind in KINDS]
            sizes = [_wire_bytes(FeatureMap(lines=features.lines)), _wire_bytes(features)]
            cpu = [cpu_ms(lambda grid=grid: extract_features(grid)), cpu_ms(lambda grid=grid: prepared(grid))]  # type: ignore[misc]
            by_log.setdefault(f"{log} {resolution} m", []).append([*counts, *sizes, *cpu])
    rows = []
    for log, found in by_log.items():
        median, worst = np.median(found, axis=0).round(1).tolist(), np.max(found, axis=0).round(1).tolist()
        names = (*KINDS, "line bytes", "all bytes")
        cpu = {
            name: f"{median[k]} ({worst[k]})"
            for k, name in ((-2, "features, CPU ms (worst)"), (-1, "all that is kept, ms (worst)"))
        }
        rows.append({"recording": log, "maps": len(found), **dict(zip(names, median, strict=False)), **cpu})
    return rows


def prepared(grid: OccupancyGrid) -> MapSnapshot:
    """Everything that matching derives from one map before it meets another, and the feature map."""
    snapshot = MapSnapshot.of(grid)
    for part in ("thin_kinds", "field", "corners", "directions", "signatures", "features"):
        getattr(snapshot, part)
    return snapshot


def _wire_bytes(features: FeatureMap) -> int:
    return len(FEATURES.pack(features)[1])


def cpu_ms(work: Callable[[], object], runs: int = 3) -> float:
    """Median CPU of some runs after a first one."""
    work()
    times = []
    for _ in range(runs):
        started = time.process_time()
        work()
        times.append((time.process_time() - started) * 1e3)
    return max(0.01, float(np.median(times)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--seeds", type=int, default=10, help="buildings per noise level (default 10)")
    parser.add_argument("--kit-stride", type=int, default=3, metavar="N", help="every N-th fitting pair of the kit (default 3)")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    noise, recordings = against_noise(range(args.seeds)), of_recordings(args.kit_stride)
    print(json.dumps({"noise": noise, "recordings": recordings}, indent=1) if args.json else tables(noise, recordings))


def tables(*of: list[dict[str, Any]]) -> str:
    return "\n\n".join(
        markdown([{name: "-" if value is None else str(value) for name, value in row.items()} for row in rows])
        for rows in of
        if rows
    )


if __name__ == "__main__":
    main()
