"""Localization on the recordings: where does the local map of the last few metres lie in a map drawn from the other scans?

.venv/bin/python -m tests.bench.localize                          all recordings; 1, 3, 6, 12 and 25 m of travel
.venv/bin/python -m tests.bench.localize --travel 3 --logs intel --queries 60
.venv/bin/python -m tests.bench.localize --json

Maps are drawn with the corrected poses, each in a frame of its own.  Every query is also asked of another building's map.
Right is what the kit calls right: half a metre at the middle of the overlap, and 3 degrees.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from agent.features.snapshot import MapSnapshot
from agent.mapping.log_odds import LogOddsGrid
from agent.merging.localization import localize
from hw.readings import LaserScan
from protocol.geometry import SE2
from protocol.grid import OccupancyGrid
from tests.bench.map_pairs import MapPair, overlap_middle
from tests.bench.recordings import load
from tests.bench.tables import markdown

LOGS = ("acapulco", "freiburg-079", "freiburg-campus", "intel", "seattle")
TRAVEL_M = (1.0, 3.0, 6.0, 12.0, 25.0)
USABLE_M = {"freiburg-campus": 30.0, "acapulco": 25.0}
USUAL_USABLE_M = 20.0
NO_RETURN_M = 49.9  # what these scanners write for a beam without an echo is more
SCAN_EVERY_M = 0.2
FREE_BELOW = (
    0.41  # one beam that passes makes a cell free: the recordings keep a scan every half metre to metre, not ten a second
)
MAX_LEFT_OUT = 0.12  # of the way: one given map serves several queries, and must still be a map of the building
MIN_SEEN = 0.6  # of what the local map knows, that the given map must know for the question to be fair


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """A recording as scans with corrected poses."""

    name: str
    scans: list[LaserScan]
    poses: NDArray[np.float64]  # (N, 3) laser in the world
    travelled_m: NDArray[np.float64]  # (N,)

    @staticmethod
    def of(name: str) -> Drive:
        recording = load(name)
        scans = [reading for reading in recording.readings if isinstance(reading, LaserScan)]
        poses = recording.reference[:, 1:]
        travelled = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))])
        turned = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(np.unwrap(poses[:, 2]))))])
        _, kept = np.unique(np.floor(travelled / SCAN_EVERY_M) + 1e6 * np.floor(turned / 0.2), return_index=True)
        kept = np.sort(kept)
        return Drive(name, [scans[i] for i in kept], poses[kept], travelled[kept])

    def mapped(self, rows: NDArray[np.int64], T_map_world: SE2, resolution_m: float) -> OccupancyGrid:
        """What these scans draw."""
        grid = LogOddsGrid(resolution_m, free_below=FREE_BELOW)
        usable_m = USABLE_M.get(self.name, USUAL_USABLE_M)
        for row in rows:
            scan, T_map_laser = self.scans[row], T_map_world @ SE2(*self.poses[row])
            returned = np.isfinite(scan.ranges_m) & (scan.ranges_m > 0.1) & (scan.ranges_m < NO_RETURN_M)
            ranges, angles = scan.ranges_m[returned].astype(float), scan.angles_rad[returned].astype(float)
            reach = np.minimum(ranges, usable_m)
            ends = T_map_laser.apply(np.column_stack([reach * np.cos(angles), reach * np.sin(angles)]))
            grid.add((T_map_laser.x_m, T_map_laser.y_m), ends, ranges <= usable_m, clears=True)
        return grid.trinary().cropped(2)


@dataclass(frozen=True, slots=True, eq=False)
class Query:
    log: str
    pair: MapPair  # ours is the given map, theirs the local one
    given: MapSnapshot


def queries(drive: Drive, travel_m: float, count: int, resolution_m: float, seed: int) -> Iterator[Query]:
    """Local maps at even distances along the drive; as many as leave the rest a map are cut out of one given map."""
    rng = np.random.default_rng([seed, round(10 * travel_m), len(drive.scans)])
    length = float(drive.travelled_m[-1])
    together = max(1, int(MAX_LEFT_OUT * length / travel_m))
    ends = np.linspace(travel_m, length, count)
    folds = -(-count // together)
    for fold in range(folds):
        windows = [(drive.travelled_m > end - travel_m - 1e-9) & (drive.travelled_m <= end) for end in ends[fold::folds]]
        others = np.flatnonzero(~np.any(windows, axis=0))
        T_given_world = _anywhere(rng)
        grid = drive.mapped(others, T_given_world, resolution_m)
        given = MapSnapshot.of(grid)
        for end, window in zip(ends[fold::folds], windows, strict=True):
            T_local_world = _anywhere(rng)
            local = drive.mapped(np.flatnonzero(window), T_local_world, resolution_m)
            truth = T_given_world @ T_local_world.inverse()
            if _share_seen(grid, local, truth) >= MIN_SEEN:
                name = f"{drive.name} {travel_m:g} m to {end:.0f} m"
                yield Query(drive.name, MapPair(name, grid, local, truth, overlap_middle(grid, local, truth)), given)


def _anywhere(rng: np.random.Generator) -> SE2:
    return SE2(*rng.uniform(-20, 20, 2), float(rng.uniform(-math.pi, math.pi)))


def _share_seen(given: OccupancyGrid, local: OccupancyGrid, truth: SE2) -> float:
    points = local.points_of(np.argwhere(local.known()))
    return float((given.values_at(truth.apply(points)) >= 0).mean()) if len(points) else 0.0


def asked(query: Query, given: MapSnapshot, is_own: bool) -> dict[str, Any]:
    """One call of `localize`; the local map's features are part of its time, those of the given map are not."""
    local = MapSnapshot.of(query.pair.theirs)
    started = time.process_time()
    result = localize(local, given)
    cpu_ms = (time.process_time() - started) * 1e3
    T = result.T_ours_theirs
    is_right = is_own and T is not None and query.pair.is_right(T)
    return {
        "query": query.pair.name,
        "log": query.log,
        "own": is_own,
        "right": is_right,
        "accepted": result.accepted,
        "error_cm": 100 * query.pair.errors(T)[0] if is_right and T is not None else None,
        "reason": result.reason,
        "cpu_ms": cpu_ms,
    }


def are_strangers(a: str, b: str) -> bool:
    return a.partition("-")[0] != b.partition("-")[0]  # freiburg-079 and freiburg-campus may share walls


def measured(logs: list[str], travel_m: list[float], count: int, resolution_m: float, seed: int) -> list[dict[str, Any]]:
    drives = {name: Drive.of(name) for name in logs}
    rng = np.random.default_rng(seed)
    whole = {
        name: MapSnapshot.of(drive.mapped(np.arange(len(drive.scans)), _anywhere(rng), resolution_m))
        for name, drive in drives.items()
    }
    rows = []
    for metres in travel_m:
        for name, drive in drives.items():
            strangers = [other for other in logs if are_strangers(name, other)]
            for number, query in enumerate(queries(drive, metres, count, resolution_m, seed)):
                rows.append({"travel_m": metres, **asked(query, query.given, True)})
                if strangers:
                    other = whole[strangers[number % len(strangers)]]
                    rows.append({"travel_m": metres, **asked(query, other, False)})
    return rows


def summed_up(rows: list[dict[str, Any]], by: str) -> str:
    told = []
    for value in dict.fromkeys(row[by] for row in rows):
        mine = [row for row in rows if row[by] == value and row["own"]]
        theirs = [row for row in rows if row[by] == value and not row["own"]]
        good = [row["error_cm"] for row in mine if row["right"] and row["accepted"]] or [math.nan]
        cpu = [row["cpu_ms"] for row in mine]
        told.append(
            {
                by: value,
                "queries": len(mine),
                "best correct": f"{np.mean([r['right'] for r in mine]):.3f}",
                "accepted, correct": f"{np.mean([r['right'] and r['accepted'] for r in mine]):.3f}",
                "wrong": sum(r["accepted"] and not r["right"] for r in mine),
                "strangers: accepted": f"{sum(r['accepted'] for r in theirs)} of {len(theirs)}",
                "error cm, median (95 %)": f"{np.median(good):.1f} ({np.percentile(good, 95):.1f})",
                "CPU ms, median (95 %)": f"{np.median(cpu):.0f} ({np.percentile(cpu, 95):.0f})",
            }
        )
    return markdown(told)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--travel", type=float, nargs="+", default=list(TRAVEL_M), metavar="M")
    parser.add_argument("--logs", nargs="+", default=list(LOGS), choices=LOGS)
    parser.add_argument("--queries", type=int, default=40, help="per recording and travel (default 40)")
    parser.add_argument("--resolution", type=float, default=0.1, metavar="M")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    rows = measured(args.logs, args.travel, args.queries, args.resolution, args.seed)
    if args.json:
        print(json.dumps(rows, indent=1))
        return
    print(f"{summed_up(rows, 'travel_m')}\n\n{summed_up(rows, 'log')}")
    for row in rows:
        if row["accepted"] and not row["right"]:
            print(f"WRONG {row['query']}{'' if row['own'] else ' in another building'}: {row['error_cm']}")


if __name__ == "__main__":
    main()
