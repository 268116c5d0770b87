"""A map of which a little changed: what everything that matching keeps of it costs, updated and made afresh.

.venv/bin/python -m tests.bench.updates                   maps of the kit in BENCH_DATA, and a drawn building
.venv/bin/python -m tests.bench.updates --tiles 8         of which so many tiles of 6.4 m lack the walls that the later state has

The tiles lie together, as what a robot sees from one place does.  Both ways must give the same, or there is no table.  The last
columns are the verdict on a pair that is aligned already, of which one map has just changed: the update, and the verdict.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from functools import partial
from typing import TypeVar

import cv2
import numpy as np

from agent.features.snapshot import MapSnapshot
from agent.merging.matching import match_maps, verify_match
from protocol.geometry import SE2
from protocol.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from tests.bench.map_pairs import MapPair, kit_pairs
from tests.bench.tables import markdown
from tests.harness.floorplans import office

TILE_M = 6.4
PARTS = ("walls", "lines", "thin_kinds", "field", "corners", "signatures", "features")
FIELDS = ("fine", "coarse", "nearest", "distance_m", "wall_share")
TABLES = ("lines", "circles", "arcs", "curves")
Made = TypeVar("Made")
T_A, T_B = SE2(3.0, -2.0, 0.3), SE2(-10.0, 5.0, 2.1)


def pairs(stride: int) -> Iterator[MapPair]:
    plan = office(7, 32)
    yield MapPair("- drawn office 0.10", plan.mapped(T_A, noise_m=0.02, seed=1), plan.mapped(T_B, noise_m=0.02, seed=2), None)
    yield from kit_pairs("main", "pos", stride)


def before(later: OccupancyGrid, tiles: int, rng: np.random.Generator) -> OccupancyGrid:
    """The map when a square of some tiles was not seen well yet: half of the walls missing, and a strip of it unknown."""
    side = round(TILE_M / later.resolution_m * math.sqrt(tiles))
    walls = np.argwhere(later.cells == OCCUPIED)
    row, col = (max(0, int(v) - side // 2) for v in walls[rng.integers(len(walls))])
    cells = later.cells.copy()
    part = cells[row : row + side, col : col + side]
    forgotten = rng.random(part.shape) < 0.5
    part[forgotten & (part == OCCUPIED)] = FREE
    part[: side // 4] = UNKNOWN
    return OccupancyGrid(cells, later.resolution_m, later.origin)


def measured(pair: MapPair, tiles: int, rng: np.random.Generator) -> dict[str, float]:
    later, theirs = pair.ours, all_kept(MapSnapshot.of(pair.theirs))
    early = all_kept(MapSnapshot.of(before(later, tiles, rng)))
    cpu: dict[str, list[float]] = defaultdict(list)
    for _ in range(3):
        fresh = _timed(cpu, "afresh", lambda: all_kept(MapSnapshot.of(later)))
        updated = _timed(cpu, "updated", lambda: all_kept(early.updated(later)))
        assert is_same(updated, fresh)
        _timed(cpu, "field afresh", lambda: MapSnapshot.of(later).field)
    T = match_maps(fresh, theirs).T_ours_theirs or SE2.identity()
    for _ in range(3):
        ready = _timed(cpu, "update for a verdict", lambda: for_a_verdict(early.updated(later)))
        _timed(cpu, "verdict", partial(verify_match, ready, theirs, T))
        _timed(cpu, "verdict again", partial(verify_match, ready, theirs, T))
    return {name: float(np.median(times)) for name, times in cpu.items()}


def all_kept(snapshot: MapSnapshot) -> MapSnapshot:
    for part in PARTS:
        getattr(snapshot, part)
    return snapshot


def for_a_verdict(snapshot: MapSnapshot) -> MapSnapshot:
    for part in ("thin_kinds", "field"):
        getattr(snapshot, part)
    return snapshot


def is_same(a: MapSnapshot, b: MapSnapshot) -> bool:
    fields = all(np.array_equal(getattr(a.field, name), getattr(b.field, name)) for name in FIELDS)
    return fields and all(np.array_equal(getattr(a.features, kind), getattr(b.features, kind)) for kind in TABLES)


def _timed(cpu: dict[str, list[float]], name: str, work: Callable[[], Made]) -> Made:
    started = time.process_time()
    made = work()
    cpu[name].append(1e3 * (time.process_time() - started))
    return made


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tiles", type=int, default=4)
    parser.add_argument("--kit-stride", type=int, default=8, metavar="N", help="every N-th fitting pair of the kit (default 8)")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    rng = np.random.default_rng(1)
    by_place: dict[str, list[dict[str, float]]] = defaultdict(list)
    for pair in pairs(args.kit_stride):
        by_place[" ".join(pair.name.split()[1:])].append(measured(pair, args.tiles, rng))
    rows = [
        {
            "map": place,
            "maps": len(found),
            **{f"{name} ms": round(float(np.median([one[name] for one in found])), 1) for name in found[0]},
        }
        for place, found in by_place.items()
    ]
    table = f"{args.tiles} tiles of {TILE_M} m changed; CPU, median\n\n{markdown(rows)}"
    print(json.dumps({"tiles": args.tiles, "rows": rows}) if args.json else table)


if __name__ == "__main__":
    main()
