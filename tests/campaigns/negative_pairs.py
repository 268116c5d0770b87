"""Pairs of maps that must not merge: other buildings, disjoint parts, mirror images, worlds that repeat.

Maps come from seeded floor plans and scanned buildings (`repeating_buildings.py`), and from the evaluation kit where BENCH_DATA
(one or more folders, separated by ':') has been built.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from agent.features.snapshot import MapSnapshot
from protocol.geometry import SE2
from protocol.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from tests.campaigns.repeating_buildings import ENDS, KINDS, REACH_M, seen
from tests.harness.floorplans import office

ENTRIES_HELD = 24  # pairs of the kit whose maps are kept at a time: every pair among those maps is a candidate
MIRRORED_HELD = 16  # of these maps, turned over


@dataclass(frozen=True, eq=False)
class Source:
    """One map and where it is from: maps of different places must never merge."""

    name: str
    place: str
    snapshot: MapSnapshot


@dataclass(frozen=True, eq=False)
class Negative:
    kind: str
    ours: Source
    theirs: Source


def negatives(seed: int, block: int, count: int) -> list[Negative]:
    """One block of pairs, the same for the same numbers: three of recordings for each that is drawn, where there are any."""
    rngs = np.random.default_rng([seed, block]).spawn(2)
    recorded = list(islice(recordings(rngs[0]), count - count // 4))
    return [*recorded, *islice(drawn(rngs[1]), count - len(recorded))]


def recordings(rng: np.random.Generator) -> Iterator[Negative]:
    """Pairs of the kit's maps without end: disjoint parts, other buildings, mirror images of the same and of other buildings."""
    found = [(folder, entry) for folder in folders() for entry in json.loads((folder / "pairs.json").read_text())]
    if not found:
        return
    chosen = [found[i] for i in rng.permutation(len(found))[:ENTRIES_HELD]]
    held = [(entry, *_both_maps(folder, entry)) for folder, entry in chosen]
    plain = [source for _, *both in held for source in both]
    mirrored = [Source(s.name + " mirrored", s.place, _mirrored(s.snapshot)) for s in plain[:MIRRORED_HELD]]
    for entry, a, b in held:
        if entry["kind"] == "neg" and entry["log_a"] == entry["log_b"]:
            yield Negative("disjoint parts of a building", a, b)
    while True:
        a, b = (plain[i] for i in rng.integers(len(plain), size=2))
        if not _related(a.place, b.place):
            yield Negative("other building", a, b)
        m = mirrored[int(rng.integers(len(mirrored)))]
        yield Negative("mirrored, same building" if a.place == m.place else "mirrored, other building", a, m)


def folders() -> list[Path]:
    roots = [Path(root) for root in os.environ.get("BENCH_DATA", "").split(":") if root]
    return [path.parent for root in roots for path in sorted(root.glob("*/pairs.json"))]


def _both_maps(folder: Path, entry: dict[str, str]) -> tuple[Source, Source]:
    return _one_map(folder, entry, "a"), _one_map(folder, entry, "b")


def _one_map(folder: Path, entry: dict[str, str], side: str) -> Source:
    with np.load(folder / "maps" / f"{entry['id']}_{side}.npz") as stored:
        grid = OccupancyGrid(stored["grid"].astype(np.int8), float(entry["res"]))
    return Source(f"{folder.parent.name}/{folder.name}/{entry['id']}{side}", entry[f"log_{side}"], MapSnapshot.of(grid))


def _related(a: str, b: str) -> bool:
    return a.partition("-")[0] == b.partition("-")[0]  # freiburg-079 and freiburg-campus may share walls


def _mirrored(snapshot: MapSnapshot) -> MapSnapshot:
    cells = np.ascontiguousarray(snapshot.grid.cells[:, ::-1])
    return MapSnapshot.of(OccupancyGrid(cells, snapshot.grid.resolution_m))


def drawn(rng: np.random.Generator) -> Iterator[Negative]:
    """Pairs of drawn maps without end: other plans, mirrored plans, disjoint ends of a plan, and what repeats."""
    while True:
        yield from repeating(rng)
        seed = int(rng.integers(1 << 30))
        plan, other = office(seed), office(seed + 1)
        T = SE2(0.0, 0.0, float(rng.uniform(-math.pi, math.pi)))
        ours = Source(f"office {seed}", "a", MapSnapshot.of(plan.mapped(T, noise_m=0.02, seed=1)))
        theirs = MapSnapshot.of(other.mapped(SE2(1.0, 2.0, float(rng.uniform(-3, 3))), noise_m=0.02, seed=2))
        yield Negative("other plan", ours, Source(f"office {seed + 1}", "b", theirs))
        yield Negative("mirrored plan", ours, Source(f"office {seed} mirrored", "b", _mirrored(ours.snapshot)))
        third = plan.width_m / 3
        left = MapSnapshot.of(plan.mapped(T, x_range_m=(-1.0, third), noise_m=0.02, seed=3))
        right = MapSnapshot.of(plan.mapped(SE2(5.0, 1.0, 1.0), x_range_m=(2 * third, 1e3), noise_m=0.02, seed=4))
        yield Negative("disjoint ends of a plan", Source("left", "a", left), Source("right", "b", right))
        a, b = (Source(f"corridor {k}", k, _corridor(rng, first)) for k, first in (("a", 0), ("b", 6)))
        yield Negative("repeating corridor", a, b)


def repeating(rng: np.random.Generator) -> Iterator[Negative]:
    """Of one building that repeats itself: its two ends, all of it against its mirror image, and against another of its kind."""
    build = KINDS[int(rng.integers(len(KINDS)))]
    kind, building, other = build.__name__, build(rng), build(rng)
    left, right = (MapSnapshot.of(seen(rng, building, part, REACH_M)) for part in ENDS)
    ours, again = (MapSnapshot.of(seen(rng, building)) for _ in range(2))
    whole = Source(kind, "a", ours)
    yield Negative(f"disjoint ends of a {kind}", Source("left", "a", left), Source("right", "b", right))
    yield Negative(f"{kind}, mirrored", whole, Source(f"{kind} mirrored", "b", _mirrored(again)))
    yield Negative(f"another {kind}", whole, Source(f"another {kind}", "b", MapSnapshot.of(seen(rng, other))))


def _corridor(rng: np.random.Generator, first_room: int) -> MapSnapshot:
    """Part of an endless corridor: the same room behind every door, and nothing to tell one stretch from the next."""
    cells = np.full((160, 420), UNKNOWN, np.int8)
    cells[70:90, 10:410] = FREE
    for k in range(10):
        x = 10 + 40 * k
        for low, high in ((20, 69), (91, 140)):
            cells[low:high, x + 1 : x + 40] = FREE
            cells[low, x : x + 41] = cells[high, x : x + 41] = OCCUPIED
            cells[low : high + 1, x] = cells[low : high + 1, x + 40] = OCCUPIED
        cells[69, x : x + 41] = cells[91, x : x + 41] = OCCUPIED
        cells[69, x + 15 : x + 25] = cells[91, x + 15 : x + 25] = FREE
    noise = rng.random(cells.shape)
    cells[(cells == OCCUPIED) & (noise < 0.05)] = FREE
    part = cells[:, 10 + 40 * (first_room // 3) : 10 + 40 * (first_room // 3) + 250]
    turned = np.ascontiguousarray(np.rot90(part, first_room))
    return MapSnapshot.of(OccupancyGrid(np.pad(turned, 3, constant_values=UNKNOWN), 0.1))
