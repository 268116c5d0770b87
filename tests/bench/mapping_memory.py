"""What a mapper holds in memory, hour after hour in one building, and which part of it grows.

    .venv/bin/python -m tests.bench.mapping_memory [--hours 3] [--world office] [--seed 0] [--scan-hz 5] [--json]

One robot explores a simulated building, and goes on through the same rooms when all is known.  A row per stretch: bytes of
each part of the mapper, every object counted once.  The growth is that of the second half (Theil-Sen); bar: 1 MB an hour.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable

import cv2
import numpy as np

from agent.mapping.mapper import Mapper
from agent.mapping.options import MappingOptions
from agent.runtime.own_loops import fit_in_own_map
from tests.bench.mapping_drives import Conditions, explore, world_of
from tests.bench.mapping_worlds import feed
from tests.bench.tables import markdown
from tests.campaigns.soak import slope_per_hour

BAR_MB_PER_H = 1.0
STRETCH_S = 600.0
ATOMS = (bool, int, float, str, bytes, type(None), type, np.generic)
Row = dict[str, object]


def held_bytes(thing: object, seen: set[int]) -> int:
    """Of an object and all that it holds, what was seen before left out."""
    waiting, total = [thing], 0
    while waiting:
        one = waiting.pop()
        if id(one) in seen or callable(one):
            continue
        seen.add(id(one))
        if isinstance(one, np.ndarray):
            total += sys.getsizeof(one) + (0 if one.base is None else one.nbytes)
            continue
        total += sys.getsizeof(one)
        if not isinstance(one, ATOMS):
            waiting += parts_of(one)
    return total


def parts_of(thing: object) -> Iterable[object]:
    if isinstance(thing, dict):
        return [*thing.keys(), *thing.values()]
    if isinstance(thing, list | tuple | set):
        return thing
    slots = [getattr(thing, name) for kind in type(thing).__mro__ for name in getattr(kind, "__slots__", ())]
    return [*slots, *getattr(thing, "__dict__", {}).values()]


def row(mapper: Mapper, hours: float) -> Row:
    """Megabytes by part."""
    local, seen = mapper.map, {id(mapper.options)}
    parts = {
        "fields": local.filter.fields,
        "paths": local.filter,
        "kept scans": local.drawing.scans,
        "grids": local.drawing,
        "loops": local.loops,
        "trajectory": local.scans,
        "odometry": mapper.odometry,
        "else": mapper,
    }
    megabytes = {name: held_bytes(part, seen) / 1e6 for name, part in parts.items()}
    return {
        "hours": round(hours, 2),
        "known m2": round(mapper.estimate().grid.known_area_m2()),
        "keyframes": len(local.filter.line),
        **{name: round(mb, 2) for name, mb in megabytes.items()},
        "MB": round(sum(megabytes.values()), 2),
        "saved MB": round(len(mapper.checkpoint()) / 1e6, 2),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hours", type=float, default=3.0)
    parser.add_argument("--world", default="office")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--scan-hz", type=float, default=5.0)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    conditions = Conditions(scan_hz=args.scan_hz)
    mapper = Mapper(MappingOptions(matching_range_m=conditions.range_m), args.seed, fit_in_own_map)
    rows: list[Row] = []
    revolutions = explore(world_of(args.world, args.seed), args.seed, 60 * args.hours, conditions)
    for number, revolution in enumerate(revolutions, start=1):
        feed(mapper, revolution)
        if number % round(STRETCH_S * args.scan_hz) == 0:
            rows.append(row(mapper, number / args.scan_hz / 3600))
            print(rows[-1], file=sys.stderr)
    later = [(3600 * float(str(r["hours"])), float(str(r["MB"]))) for r in rows[len(rows) // 2 :]]
    growth = slope_per_hour(later)
    print(json.dumps({"rows": rows, "MB an hour": growth}) if args.json else f"{markdown(rows)}\n\nMB an hour: {growth:.2f}")
    return 0 if growth <= BAR_MB_PER_H else 1


if __name__ == "__main__":
    sys.exit(main())
