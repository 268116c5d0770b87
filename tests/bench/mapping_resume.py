"""A mapper stopped and restored in the middle of real recordings: is the map the same as without?

    .venv/bin/python -m tests.bench.mapping_resume [--logs intel,freiburg-079] [--times 10] [--seed 0] [--json]

Every recording is drawn twice: in one go, and saved and restored from its bytes at evenly spread moments.  Grid, trajectory and
the checkpoint at the end must be the same to the bit.
"""

from __future__ import annotations

import argparse
import sys
import time

import cv2
import numpy as np

from agent.mapping.mapper import Mapper
from agent.mapping.options import MappingOptions
from agent.runtime.own_loops import fit_in_own_map
from hw.readings import Odometry
from tests.bench import recordings
from tests.bench.mapping import LOGS, Readings
from tests.bench.tables import print_rows

Row = dict[str, object]


def drawn(readings: Readings, seed: int, stops: set[int]) -> tuple[Mapper, list[tuple[int, float, float]]]:
    """The mapper at the end, and bytes, seconds to save and seconds to restore of every stop."""
    mapper, saved = Mapper(MappingOptions(), seed, fit_in_own_map), []
    for number, reading in enumerate(readings):
        if number in stops:
            times_s = [time.process_time()]
            data = mapper.checkpoint()
            times_s.append(time.process_time())
            mapper = Mapper.restore(data, MappingOptions(), fit_in_own_map)
            times_s.append(time.process_time())
            saved.append((len(data), *np.diff(times_s).tolist()))
        if isinstance(reading, Odometry):
            mapper.add_odometry(reading)
        else:
            mapper.add_scan(reading)
    mapper.finish()
    return mapper, saved


def row(name: str, seed: int, times: int) -> Row:
    readings = recordings.load(name).readings
    stops = {len(readings) * k // (times + 1) for k in range(1, times + 1)}
    whole, _ = drawn(readings, seed, set())
    resumed, saved = drawn(readings, seed, stops)
    megabytes, save_s, restore_s = np.max(saved, axis=0).tolist()
    is_same_end = Mapper.restore(whole.checkpoint(), MappingOptions()).checkpoint() == resumed.checkpoint()
    return {
        "log": name,
        "restored": len(saved),
        "same grid": whole.estimate().grid.content_hash() == resumed.estimate().grid.content_hash(),
        "same trajectory": np.array_equal(whole.map.trajectory(), resumed.map.trajectory()),
        "same checkpoint": is_same_end,
        "largest MB": round(megabytes / 1e6, 2),
        "save ms": round(1e3 * save_s),
        "restore ms": round(1e3 * restore_s),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--logs", default="intel,freiburg-079", help=f"of {LOGS}")
    parser.add_argument("--times", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    if not (recordings.SHARED / "data" / "carmen").is_dir():
        sys.exit(f"no recordings in {recordings.SHARED / 'data' / 'carmen'}; set MAPQUILT_SHARED to the folder that holds data/")
    rows = [row(name, args.seed, args.times) for name in args.logs.split(",")]
    print_rows(rows, as_json=args.json)
    return 0 if all(r["same grid"] and r["same trajectory"] and r["same checkpoint"] for r in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
