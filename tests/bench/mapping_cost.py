"""What mapping costs, against each thing that can grow: beams, scans a second, particles, and the map itself.

    .venv/bin/python -m tests.bench.mapping_cost [--minutes 2] [--world office] [--seed 0] [--json]

One robot explores a simulated building; everything but the varied thing stays at 360 beams, 10 Hz and 30 particles.  CPU is
process time of the filter alone, one thread.  The last rows are one run of five times `--minutes`, cut into stretches: CPU of
each beside the area known by then.
"""

from __future__ import annotations

import argparse
import json

import cv2

from agent.mapping.mapper import Mapper
from agent.mapping.options import MappingOptions
from tests.bench.mapping_drives import Conditions, explore, world_of
from tests.bench.mapping_worlds import feed
from tests.bench.tables import markdown

USUAL, PARTICLES = Conditions(), 30
STRETCHES = 5
Row = dict[str, object]


def cost(world: str, seed: int, minutes: float, beams: int, scan_hz: float, particles: int, stretches: int = 1) -> list[Row]:
    """One run, cut into stretches of equal length: a row each."""
    mapper = Mapper(MappingOptions(particles=particles, matching_range_m=USUAL.range_m), seed)
    per_stretch = max(1, int(minutes * 60 * scan_hz / stretches))
    rows, cpu_s = [], 0.0
    conditions = Conditions(beams=beams, scan_hz=scan_hz)
    for number, revolution in enumerate(explore(world_of(world, seed), seed, minutes, conditions), start=1):
        cpu_s += feed(mapper, revolution)[1]
        if number % per_stretch == 0:
            rows.append(_row(mapper, beams, scan_hz, particles, cpu_s / per_stretch))
            cpu_s = 0.0
    return rows


def _row(mapper: Mapper, beams: int, scan_hz: float, particles: int, cpu_s: float) -> Row:
    return {
        "beams": beams,
        "scans/s": scan_hz,
        "particles": particles,
        "known m2": round(mapper.estimate().grid.known_area_m2()),
        "CPU ms a scan": round(1e3 * cpu_s, 2),
        "of a core %": round(100 * cpu_s * scan_hz, 1),
        "filter MB": round(mapper.map.filter.fields.used_bytes() / 1e6, 1),
    }


def table(world: str, seed: int, minutes: float) -> list[Row]:
    rows = []
    for beams in (180, 360, 720, 1440):
        rows += cost(world, seed, minutes, beams, USUAL.scan_hz, PARTICLES)
    for scan_hz in (5.0, 20.0):
        rows += cost(world, seed, minutes, USUAL.beams, scan_hz, PARTICLES)
    for particles in (10, 100):
        rows += cost(world, seed, minutes, USUAL.beams, USUAL.scan_hz, particles)
    return rows + cost(world, seed, 5 * minutes, USUAL.beams, USUAL.scan_hz, PARTICLES, STRETCHES)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=2.0)
    parser.add_argument("--world", default="office")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    rows = table(arguments.world, arguments.seed, arguments.minutes)
    if arguments.json:
        print(json.dumps(rows))
        return
    print(markdown(rows))


if __name__ == "__main__":
    main()
