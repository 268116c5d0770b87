"""The same two maps in every frame: all yaws in one-degree steps, random origins, both orders; and is the covariance honest?

.venv/bin/python -m tests.campaigns.every_yaw                   360 yaws of a drawn building's halves
.venv/bin/python -m tests.campaigns.every_yaw --step-deg 10     a sample
.venv/bin/python -m tests.campaigns.every_yaw --kit-stride 2    and every second fitting pair of the kit in BENCH_DATA

Every map is drawn anew in its frame, with its own noise.  Normalised squared errors (x, y, yaw) have a mean of 3 and lie below
7.8 in 95 % of cases when the covariance is what it says.  The exit code counts yaws whose answer is another one.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from agent.features.snapshot import MapSnapshot
from agent.merging.matching import match_maps
from agent.merging.result import MergeResult
from protocol.geometry import SE2, wrap_angle
from tests.bench.map_pairs import MapPair, kit_pairs, overlap_middle
from tests.bench.tables import markdown
from tests.harness.floorplans import office

CHI2_95, CHI2_99 = 7.815, 11.345  # of three degrees of freedom


@dataclass(frozen=True, slots=True)
class Answer:
    accepted: bool
    is_right: bool
    error_m: float
    error_rad: float
    nees: float  # squared error over covariance
    there_and_back: float  # the same of match(b, a)'s inverse against match(a, b)


def turned_pairs(step_deg: int, resolution_m: float, seed: int) -> Iterator[MapPair]:
    """Two halves of a building that share its middle, the second in a frame of every yaw."""
    rng = np.random.default_rng(seed)
    plan = office(seed)
    T_a = SE2(3.0, -2.0, 0.3)
    ours = plan.mapped(T_a, resolution_m, (-1.0, 0.7 * plan.width_m), noise_m=0.02, seed=1, hit=True)
    for yaw_deg in range(0, 360, step_deg):
        T_b = SE2(*rng.uniform(-50, 50, 2), math.radians(yaw_deg))
        theirs = plan.mapped(T_b, resolution_m, (0.3 * plan.width_m, 1e3), noise_m=0.02, seed=1000 + yaw_deg, hit=True)
        truth = T_a @ T_b.inverse()
        yield MapPair(f"{yaw_deg} deg", ours, theirs, truth, overlap_middle(ours, theirs, truth))


def answer(pair: MapPair) -> Answer:
    ours, theirs = MapSnapshot.of(pair.ours), MapSnapshot.of(pair.theirs)
    there, back = match_maps(ours, theirs), match_maps(theirs, ours).inverse()
    T = there.T_ours_theirs
    if T is None or pair.truth is None or not pair.is_right(T):
        return Answer(there.accepted, False, math.nan, math.nan, math.nan, math.nan)
    return Answer(
        there.accepted and back.accepted,
        True,
        *pair.errors(T),
        squared_error(T, pair.truth, there.covariance),
        math.inf if back.T_ours_theirs is None else squared_error(T, back.T_ours_theirs, mean_covariance(there, back)),
    )


def mean_covariance(a: MergeResult, b: MergeResult) -> NDArray[np.float64]:
    """Of two answers from the same maps: their errors are not independent, so the covariances do not add."""
    mean: NDArray[np.float64] = 0.5 * (a.covariance + b.covariance)
    return mean


def squared_error(T: SE2, truth: SE2, covariance: NDArray[np.float64]) -> float:
    error = np.array([T.x_m - truth.x_m, T.y_m - truth.y_m, wrap_angle(T.theta_rad - truth.theta_rad)])
    return float(error @ np.linalg.solve(covariance, error))


def row(name: str, answers: list[Answer]) -> dict[str, object]:
    good = [a for a in answers if a.accepted and a.is_right]
    told: dict[str, object] = {
        "pairs": name,
        "tried": len(answers),
        "both orders merged, right": len(good),
        "wrong": sum(a.accepted and not a.is_right for a in answers),
    }
    if not good:
        return told
    cm, deg = 100 * np.array([a.error_m for a in good]), np.degrees([a.error_rad for a in good])
    nees, apart = np.array([a.nees for a in good]), np.array([a.there_and_back for a in good])
    trimmed = np.sort(nees)[: max(1, int(0.95 * len(nees)))].mean()
    return {
        **told,
        "cm median (95 %, worst)": f"{np.median(cm):.1f} ({np.percentile(cm, 95):.1f}, {cm.max():.1f})",
        "deg median (95 %)": f"{np.median(deg):.3f} ({np.percentile(deg, 95):.3f})",
        "squared error: mean, 5 % trimmed": f"{nees.mean():.2f}, {trimmed:.2f}",
        "below 7.8": f"{100 * (nees < CHI2_95).mean():.0f} %",
        "there and back agree": f"{100 * (apart < CHI2_99).mean():.1f} %",
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--step-deg", type=int, default=1)
    parser.add_argument("--resolution", type=float, default=0.1, metavar="M")
    parser.add_argument("--seed", type=int, default=7, help="of the building")
    parser.add_argument("--kit-stride", type=int, default=0, metavar="N", help="also every N-th fitting pair of the kit")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    started = time.process_time()
    answers = {f"every {args.step_deg} deg": [answer(pair) for pair in turned_pairs(args.step_deg, args.resolution, args.seed)]}
    if args.kit_stride:
        answers["kit"] = [answer(pair) for pair in kit_pairs("main", "pos", args.kit_stride)]
    rows, cpu_s = [row(name, found) for name, found in answers.items()], time.process_time() - started
    table = f"{markdown(rows)}\n\nCPU {cpu_s:.0f} s, with drawing the maps"
    print(json.dumps({"rows": rows, "CPU s": round(cpu_s)}) if args.json else table)
    turned = next(iter(answers.values()))
    return min(100, sum(not (a.accepted and a.is_right) for a in turned))


if __name__ == "__main__":
    sys.exit(main())
