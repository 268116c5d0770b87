"""Maps from raw odometry, measured: errors, crispness, time and memory of the particle filter on real recordings.

    .venv/bin/python -m tests.bench.mapping [--logs intel,...] [--seeds 0,1,2,3,4] [--faults] [--particles 30] [--json]

relations   hand-checked relative poses (Kuemmerle et al., 2009), mean error in metres; between scans farther apart than 20 cm
            the trajectory has odometry's shape.  The corrected log itself ("reference") stands below each log.
loop        pairs more than 50 scans apart and less than 3 m, against the corrected log (made by a filter too: not the truth)
occupied    5 cm cells per 1000 hits of the map drawn from the trajectory, entropy in m^2 bit: fewer is crisper
ms          CPU time of one process per scan fed, and per scan that entered the filter
MB          memory of all particles' fields at the end
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from agent.mapping.log_odds import UNIT, LogOddsGrid
from agent.mapping.mapper import Mapper
from agent.mapping.options import MappingOptions
from agent.runtime.own_loops import fit_in_own_map
from hw.readings import LaserScan, Odometry
from protocol.geometry import SE2
from tests.bench import recordings
from tests.bench.recordings import Recording
from tests.bench.tables import heading, line

LOGS = "intel,freiburg-079,freiburg-campus,acapulco"
GMAPPING_MS = {"intel": 87.0, "freiburg-079": 151.0}  # MAPPING.md 3a: GMapping C++, 30 particles, same logs
CRISPNESS_RANGE_M = 30.0
Readings = list[LaserScan | Odometry]


def run(recording: Recording, readings: Readings, seed: int, particles: int) -> dict[str, object]:
    """One log, one seed: a row of the table."""
    mapper = Mapper(MappingOptions(particles=particles), seed, fit_in_own_map)
    keyframes = held = 0
    started = time.process_time()
    for reading in readings:
        if isinstance(reading, Odometry):
            mapper.add_odometry(reading)
        else:
            outcome = mapper.add_scan(reading)
            keyframes += outcome.is_keyframe
            held += bool(outcome.reason)
    mapper.finish()
    cpu_ms = 1e3 * (time.process_time() - started)
    scans = sum(isinstance(r, LaserScan) for r in readings)
    row: dict[str, object] = {"log": recording.name, "seed": seed, **scores(recording, mapper.map.trajectory())}
    row |= {
        "ms/scan": round(cpu_ms / scans, 2),
        "ms/keyframe": round(cpu_ms / max(keyframes, 1), 2),
        "of GMapping": round(cpu_ms / keyframes / GMAPPING_MS[recording.name], 3) if recording.name in GMAPPING_MS else None,
        "MB": round(mapper.map.filter.fields.used_bytes() / 1e6, 1),
        "held": held,
        "loops": mapper.loops_closed,
        "epoch": mapper.epoch,
    }
    return row


def scores(recording: Recording, trajectory: NDArray[np.float64]) -> dict[str, object]:
    """What a trajectory is worth; its stamps are those of the readings."""
    row: dict[str, object] = {"relations m": None, "relations deg": None}
    if recording.name in recordings.RELATION_OFFSET_S:
        errors = recordings.relation_errors(recording.name, recording.dense(trajectory))
        row = {
            "relations m": round(float(errors[:, 0].mean()), 4),
            "relations deg": round(float(np.degrees(errors[:, 1].mean())), 3),
        }
    consecutive, loops = recordings.corrected_errors(reference(recording), trajectory)
    occupied, entropy = crispness(recording, trajectory)
    return row | {
        "step m": round(float(consecutive[:, 0].mean()), 4),
        "loop m": round(float(loops[:, 0].mean()), 3),
        "occupied/1000": round(occupied, 1),
        "entropy": round(entropy, 1),
    }


def reference(recording: Recording) -> NDArray[np.float64]:
    """The corrected log as a trajectory with the stamps of the readings."""
    return np.column_stack([recording.scan_stamps_s, recording.reference[:, 1:]])


def crispness(recording: Recording, trajectory: NDArray[np.float64]) -> tuple[float, float]:
    """Occupied cells per 1000 hits and entropy in m^2 bit of the map drawn from where the trajectory says."""
    grid, hits = LogOddsGrid(0.05), 0
    poses = recordings.poses_at(trajectory, recording.scan_stamps_s)
    scans = [reading for reading in recording.readings if isinstance(reading, LaserScan)]
    for scan, (x, y, theta) in zip(scans, poses.tolist(), strict=True):
        returned = np.isfinite(scan.ranges_m)
        ranges = np.minimum(scan.ranges_m[returned], CRISPNESS_RANGE_M)
        angles = scan.angles_rad[returned]
        is_hit = ranges < CRISPNESS_RANGE_M
        ends = SE2(x, y, theta).apply(np.stack([ranges * np.cos(angles), ranges * np.sin(angles)], axis=1))
        grid.add((x, y), ends, is_hit, clears=True)
        hits += int(np.count_nonzero(is_hit))
    probability = 1.0 / (1.0 + np.exp(-grid.cells[grid.cells != 0] / UNIT))
    entropy = -(probability * np.log2(probability) + (1 - probability) * np.log2(1 - probability)).sum() * 0.05**2
    return 1e3 * float(np.count_nonzero(grid.cells >= grid.occupied_from)) / hits, float(entropy)


def drop_scans(readings: Readings) -> Readings:
    """Every fifth scan is lost."""
    rng = np.random.default_rng(0)
    return [r for r in readings if isinstance(r, Odometry) or rng.random() >= 0.2]


def two_gaps(readings: Readings) -> Readings:
    """Six scans in a row are lost, twice."""
    scans = [i for i, r in enumerate(readings) if isinstance(r, LaserScan)]
    lost = {scans[len(scans) * share // 10 + k] for share in (3, 7) for k in range(6)}
    return [r for i, r in enumerate(readings) if i not in lost]


def changed(readings: Readings, change: Callable[[int, SE2], SE2]) -> Readings:
    """Odometry rebuilt from changed steps between scans; `change` is given the number of the scan."""
    out: Readings = []
    last: SE2 | None = None
    pose, scan = SE2.identity(), 0
    for reading in readings:
        if isinstance(reading, Odometry):
            raw = SE2(reading.x_m, reading.y_m, reading.theta_rad)
            pose = pose @ change(scan, last.inverse() @ raw) if last is not None else raw
            last = raw
            out.append(replace(reading, x_m=pose.x_m, y_m=pose.y_m, theta_rad=pose.theta_rad))
        else:
            scan += 1
            out.append(reading)
    return out


def slips(readings: Readings) -> Readings:
    """Forty times between two scans half the way is lost, and up to 15 degrees are gained."""
    rng = np.random.default_rng(0)
    n = sum(isinstance(r, LaserScan) for r in readings)
    turns = dict(zip(rng.choice(n, 40, replace=False).tolist(), np.radians(rng.uniform(-15, 15, 40)).tolist(), strict=True))
    done: set[int] = set()

    def change(scan: int, step: SE2) -> SE2:
        if scan not in turns:
            return step
        turn = 0.0 if scan in done else turns[scan]
        done.add(scan)
        return SE2(0.5 * step.x_m, 0.5 * step.y_m, step.theta_rad + turn)

    return changed(readings, change)


def reset(readings: Readings) -> Readings:
    """The encoder board reboots half way: odometry begins at zero again."""
    half = len(readings) // 2
    first = next(r for r in readings[half:] if isinstance(r, Odometry))
    back = SE2(first.x_m, first.y_m, first.theta_rad).inverse()
    out = list(readings[:half])
    for reading in readings[half:]:
        if isinstance(reading, Odometry):
            pose = back @ SE2(reading.x_m, reading.y_m, reading.theta_rad)
            out.append(replace(reading, x_m=pose.x_m, y_m=pose.y_m, theta_rad=pose.theta_rad))
        else:
            out.append(reading)
    return out


def biased(readings: Readings) -> Readings:
    """One degree too much between any two scans."""
    seen: set[int] = set()

    def change(scan: int, step: SE2) -> SE2:
        extra = 0.0 if scan in seen else np.radians(1.0)
        seen.add(scan)
        return SE2(step.x_m, step.y_m, step.theta_rad + extra)

    return changed(readings, change)


def no_odometry(readings: Readings) -> Readings:
    return [r for r in readings if isinstance(r, LaserScan)]


FAULTS: dict[str, Callable[[Readings], Readings]] = {
    "drop 20 %": drop_scans,
    "two gaps": two_gaps,
    "40 slips": slips,
    "odometry reset": reset,
    "+1 deg a step": biased,
    "no odometry": no_odometry,
}


def rows_of(name: str, seeds: list[int], particles: int, faults: bool) -> Iterator[dict[str, object]]:
    """Row by row, as they are measured."""
    recording = recordings.load(name)
    if faults:
        for fault, change in FAULTS.items():
            readings = change(recording.readings)
            for seed in seeds:
                yield {"fault": fault, **run(recording, readings, seed, particles)}
        return
    for seed in seeds:
        yield run(recording, recording.readings, seed, particles)
    yield {"log": name, "seed": "reference", **scores(recording, reference(recording))}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--logs", default=LOGS)
    parser.add_argument("--seeds", default="0,1,2,3,4")
    parser.add_argument("--particles", type=int, default=30)
    parser.add_argument(
        "--faults", action="store_true", help="corrupted inputs instead of the clean logs; intel unless --logs says more"
    )
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    if not (recordings.SHARED / "data" / "carmen").is_dir():
        sys.exit(f"no recordings in {recordings.SHARED / 'data' / 'carmen'}; set MAPQUILT_SHARED to the folder that holds data/")
    logs = "intel" if arguments.faults and arguments.logs == LOGS else arguments.logs
    every: list[dict[str, object]] = []
    columns: list[str] = []
    for name in logs.split(","):
        for row in rows_of(name, [int(s) for s in arguments.seeds.split(",")], arguments.particles, arguments.faults):
            every.append(row)
            if not columns and not arguments.json:
                columns = list(row)
                print(heading(columns))
            if not arguments.json:
                print(line(row, columns), flush=True)
    if arguments.json:
        print(json.dumps(every))


if __name__ == "__main__":
    main()
