"""What a fleet costs each robot as it grows, up to a thousand robots, in simulation.

    .venv/bin/python -m tests.campaigns.fleet_scale [--sizes 2 5 10 30 100 300 1000] [--minutes 2] [--json FILE] [--svg FILE]

Robots stand on a grid of places 9 m apart and see 8 m around them, so each overlaps its neighbours; they run the real
coordinators, and every byte is counted as it is encoded.  The first minute is the meeting, the last one the steady state.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from agent.fleet.effects import Match, MatchKind
from agent.fleet.options import FleetOptions
from agent.merging.result import MatchStatus, MergeResult
from protocol.features import FeatureMap
from protocol.geometry import SE2
from tests.fleet.explorer import Explorer, judged, random_world
from tests.fleet.simulation import Fleet, Node

SPACING_M, RADIUS_M, CELL_M = 9.0, 8.0, 1.0


@dataclass(frozen=True, slots=True)
class Row:
    """One size of fleet; per robot and minute."""

    robots: int
    groups: int
    largest_group: int
    heard_messages: float  # steady state
    heard_bytes: float
    sent_bytes: float  # pushed once; the network copies it
    pulled_bytes_first: float  # in the first minute
    pulled_bytes: float  # in the last
    cpu_ms: float  # of all coordinators and the simulated network, steady state
    wall_s: float


def place_of(i: int, side: int) -> SE2:
    offset = SPACING_M * (side - 1) / 2
    return SE2(SPACING_M * (i % side) - offset, SPACING_M * (i // side) - offset, 0.3 * i)


def features_of(place: SE2) -> FeatureMap:
    """Walls whose lengths tell the neighbourhood, as real ones do."""
    corners = [(round(place.x_m / SPACING_M) + dx, round(place.y_m / SPACING_M) + dy) for dx in (0, 1) for dy in (0, 1)]
    lengths = [2.0 + 1.1 ** ((37 * x + 101 * y) % 60) for x, y in corners]
    return FeatureMap(lines=np.array([[0, 0, 0, length, 0.01, 0.01] for length in lengths], np.float32))


def judge(fleet: Fleet, node: Node, job: Match) -> MergeResult:
    """The truth; robots far apart are told so without looking at cells."""
    here, there = node.explorer, fleet.nodes[job.peer].explorer
    assert here is not None and there is not None
    if here.T_world_robot.distance_m(there.T_world_robot) > 2.0 * SPACING_M:
        return MergeResult.none("far apart")
    T = job.T_ours_theirs if job.kind is MatchKind.VERIFY else fleet.true_T(node.robot, job.peer)
    assert T is not None
    result = judged(job.ours, job.theirs, T)
    return result if result.status is MatchStatus.MERGED else MergeResult.none("too little in common")


def measure(robots: int, minutes: int) -> Row:
    started_s = time.monotonic()
    side = math.ceil(math.sqrt(robots))
    size_m = SPACING_M * side + 4 * RADIUS_M
    world = random_world(7, size_m, CELL_M, walls=int(size_m**2 / 50))
    fleet = Fleet(robots, judge=judge, is_encoded=False)
    fleet.tick_s = 0.2 if robots <= 100 else 1.0
    options = FleetOptions()
    for i in range(robots):
        place = place_of(i, side)
        explorer = Explorer.at(world, place, 0.1 * i)
        explorer.look(place, RADIUS_M)
        explorer.features = features_of(place)
        fleet.add(f"r{i:04}", explorer, options)
    nodes = list(fleet.nodes.values())
    fleet.run(60.0)
    pulled_first = sum(node.pulled_bytes for node in nodes)
    fleet.run(60.0 * max(0, minutes - 2))
    before = [(n.received_messages, n.received_bytes, sum(n.sent.values()), n.pulled_bytes) for n in nodes]
    cpu_s = time.process_time()
    fleet.run(60.0)
    cpu_s = time.process_time() - cpu_s
    after = [(n.received_messages, n.received_bytes, sum(n.sent.values()), n.pulled_bytes) for n in nodes]
    heard, heard_bytes, sent, pulled = (np.array(after, float) - np.array(before, float)).mean(axis=0)
    assert nodes[0].coordinator is not None
    sizes: dict[str, int] = {}
    for node in nodes:
        assert node.coordinator is not None
        group = node.coordinator._ledger.group
        sizes[min(group.T_root) if group else node.robot] = len(group.T_root) if group else 1
    return Row(
        robots,
        len(sizes),
        max(sizes.values()),
        float(heard),
        float(heard_bytes),
        float(sent - pulled),
        pulled_first / robots,
        float(pulled),
        1000.0 * cpu_s / robots,
        round(time.monotonic() - started_s, 1),
    )


def draw(rows: list[Row], file: Path) -> None:
    """Bytes a minute over fleet size, both logarithmic, as a small SVG."""
    low, high = 1.0, max(row.robots for row in rows)

    def at(row: Row, value: float) -> str:
        x = 60 + 520 * math.log10(row.robots / low) / math.log10(high / low)
        return f"{x:.1f},{330 - 50 * math.log10(max(value, 1.0)):.1f}"

    curves = {
        "heard": "heard_bytes",
        "pushed": "sent_bytes",
        "pulled": "pulled_bytes",
        "pulled, first minute": "pulled_bytes_first",
    }
    parts = ['<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 640 380" font-family="sans-serif" font-size="12">']
    for power in range(7):
        y = 330 - 50 * power
        parts.append(f'<line x1="60" x2="580" y1="{y}" y2="{y}" stroke="#ddd"/><text x="8" y="{y + 4}">{10**power:,} B</text>')
    for row in rows:
        x = at(row, 1.0).split(",")[0]
        parts.append(f'<text x="{x}" y="350" text-anchor="middle">{row.robots}</text>')
    for i, (name, field) in enumerate(curves.items()):
        colour = ("#0b6", "#06c", "#c60", "#999")[i]
        points = " ".join(at(row, getattr(row, field)) for row in rows)
        parts.append(f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="2"/>')
        parts.append(f'<text x="{70 + 130 * i}" y="14" fill="{colour}">{name}</text>')
    parts.append('<text x="320" y="370" text-anchor="middle">robots; bytes per robot and minute</text></svg>')
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("\n".join(parts) + "\n")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=[2, 5, 10, 30, 100, 300, 1000])
    parser.add_argument("--minutes", type=int, default=2)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--svg", type=Path, default=Path("out/fleet_scale.svg"))
    args = parser.parse_args()
    rows = []
    print("| robots | groups (largest) | heard a minute | pushed | pulled: first minute, later | CPU ms a robot-minute |")
    print("| --- | --- | --- | --- | --- | --- |")
    for size in args.sizes:
        rows.append(row := measure(size, args.minutes))
        print(
            f"| {row.robots} | {row.groups} ({row.largest_group}) | {row.heard_messages:,.0f} messages, {row.heard_bytes:,.0f} B "
            f"| {row.sent_bytes:,.0f} B | {row.pulled_bytes_first:,.0f}, {row.pulled_bytes:,.0f} B | {row.cpu_ms:,.0f} |",
            flush=True,
        )
        if args.json:
            args.json.parent.mkdir(parents=True, exist_ok=True)
            args.json.write_text(json.dumps([asdict(row) for row in rows], indent=1) + "\n")
    draw(rows, args.svg)
    return 0


if __name__ == "__main__":
    sys.exit(main())
