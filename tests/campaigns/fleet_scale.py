"""What a fleet costs each robot as it grows, in simulation.

    .venv/bin/python -m tests.campaigns.fleet_scale [--sizes 2 10 30 100 300 1000] [--json FILE] [--svg FILE]

Five robots a building, in a row: each map overlaps those beside it, and no map of another building.  Maps are there at the
start and stand still.  All hear all, as in a peer mesh without loss.  The coordinators and the codec are the real ones;
matches are judged on the simulated cells; a message is encoded once and heard by everybody as one object, so sizes are the
codec's, without Zenoh's and TCP's own.  Large fleets are simulated with fewer steps: a coordinator looks at 64 peers a step,
five steps a second; at 300 and 1,000 robots it gets one step a second, so their meeting is slower than a real one.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from agent.fleet.effects import Fetch, Match, MatchKind
from agent.merging.result import MergeResult
from protocol.codec import encode
from protocol.features import FeatureMap
from protocol.geometry import SE2
from protocol.messages import Message
from tests.bench.line_chart import log_log_chart
from tests.bench.tables import markdown
from tests.fleet.explorer import Explorer, judged, random_world
from tests.fleet.processes import Node
from tests.fleet.simulation import Fleet

ROBOTS_A_BUILDING, SPACING_M, RADIUS_M, CELL_M, SIDE_M = 5, 9.0, 8.0, 0.5, 60.0
_WALLS_A_PLACE = 6  # two robots side by side share those between them
_PICTURE = Path(__file__).resolve().parents[1] / "bench" / "pictures" / "fleet_scale.svg"


@dataclass(frozen=True, slots=True)
class Times:
    """How long a fleet is simulated: while it meets, then in its steady state."""

    meeting_s: float
    steady_s: float
    tick_s: float


def times_of(robots: int) -> Times:
    """A robot of a large fleet beats every robots / 40 seconds; the steady state is longer than that."""
    if robots <= 30:
        return Times(60.0, 60.0, 0.2)
    if robots <= 100:
        return Times(60.0, 60.0, 0.5)
    return Times(90.0, 30.0, 1.0) if robots <= 300 else Times(120.0, 30.0, 1.0)


@dataclass(frozen=True, slots=True)
class Row:
    """One size of fleet; means over its robots."""

    robots: int
    meeting_s: float
    steady_s: float
    tick_s: float
    meeting_heard_bytes: float  # in the whole meeting
    meeting_pushed_bytes: float
    meeting_pulled_bytes: float
    merged_share: float  # of the robots, at the end: their global map holds their whole building
    heard_messages: float  # a minute of the steady state, like all below
    heard_bytes: float
    pushed_messages: float  # handed to the network once, which copies it
    pushed_bytes: float
    pulled_messages: float
    pulled_bytes: float
    most_peers: int  # entries in the largest peer table
    cpu_s: float  # the whole run: all robots, the network and the matcher


class Crowd(Fleet):
    """A lossless mesh: a message is one event, whoever hears it."""

    def __init__(self, robots: int, tick_s: float) -> None:
        super().__init__(robots, judge=judge, is_encoded=False)
        self.tick_s = tick_s
        self._pulls = 0

    def publish(self, node: Node, message: Message) -> None:
        size = len(encode(message))
        kind = type(message).__name__
        node.sent[kind] += size
        node.messages[kind] += 1
        self.at(self.rng.uniform(*self.link.delay_s), lambda: self._spread(node, message, size))

    def _spread(self, sender: Node, message: Message, size: int) -> None:
        for node in self.nodes.values():
            if node is not sender and node.coordinator is not None:
                node.received_messages += 1
                node.received_bytes += size
                effects = node.coordinator.on_message(message, self.now_s)
                if effects:
                    self.carry_out(node, effects)

    def _pull(self, node: Node, fetch: Fetch) -> Message | None:
        answer = super()._pull(node, fetch)
        self._pulls += answer is not None
        return answer

    def totals(self) -> dict[str, float]:
        """Means over all robots, so far."""
        nodes = list(self.nodes.values())
        pulled_bytes = sum(node.pulled_bytes for node in nodes)
        sums = {
            "heard_messages": sum(node.received_messages for node in nodes),
            "heard_bytes": sum(node.received_bytes for node in nodes),
            "pushed_messages": sum(node.messages.total() for node in nodes) - self._pulls,
            "pushed_bytes": sum(node.sent.total() for node in nodes) - pulled_bytes,
            "pulled_messages": self._pulls,
            "pulled_bytes": pulled_bytes,
        }
        return {name: value / len(nodes) for name, value in sums.items()}


def judge(fleet: Fleet, node: Node, job: Match) -> MergeResult:
    """The cells at the true transform, in one building; robots of two buildings share nothing."""
    here, there = node.explorer, fleet.nodes[job.peer].explorer
    assert here is not None and there is not None
    if here.world is not there.world:
        return MergeResult.none("another building")
    T = job.T_ours_theirs if job.kind is MatchKind.VERIFY else fleet.true_T(node.robot, job.peer)
    assert T is not None
    return judged(job.ours, job.theirs, T)


def robot_in(building: int, place: int, world_seed: int) -> Explorer:
    """A robot that has looked around its place once."""
    world = random_world(world_seed, SIDE_M, CELL_M, walls=int(SIDE_M**2 / 25))
    pose = SE2(SPACING_M * (place - (ROBOTS_A_BUILDING - 1) / 2), 0.0, 0.3 * place)
    explorer = Explorer.at(world, pose, 0.1 * building)
    explorer.look(pose, RADIUS_M)
    lengths_m = np.concatenate(
        [np.random.default_rng((building, place + side)).uniform(1.0, 15.0, _WALLS_A_PLACE) for side in (0, 1)]
    )
    lines = np.zeros((len(lengths_m), 6), np.float32)
    lines[:, 3], lines[:, 4:] = lengths_m, 0.01
    explorer.features = FeatureMap(lines=lines)
    return explorer


def measure(robots: int) -> Row:
    times, cpu_s = times_of(robots), time.process_time()
    fleet = Crowd(robots, times.tick_s)
    for i in range(robots):
        building, place = divmod(i, ROBOTS_A_BUILDING)
        fleet.add(f"r{i:04}", robot_in(building, place, 7 + building))
    fleet.run(times.meeting_s)
    met = fleet.totals()
    fleet.run(times.steady_s)
    steady = {name: (value - met[name]) * 60.0 / times.steady_s for name, value in fleet.totals().items()}
    return Row(
        robots=robots,
        meeting_s=times.meeting_s,
        steady_s=times.steady_s,
        tick_s=times.tick_s,
        meeting_heard_bytes=met["heard_bytes"],
        meeting_pushed_bytes=met["pushed_bytes"],
        meeting_pulled_bytes=met["pulled_bytes"],
        merged_share=merged_share(fleet),
        most_peers=max(len(node.coordinator._ledger.peers) for node in fleet.nodes.values() if node.coordinator),
        cpu_s=time.process_time() - cpu_s,
        **steady,
    )


def merged_share(fleet: Fleet) -> float:
    """Share of the robots whose global map holds everybody of their building."""
    names = list(fleet.nodes)
    merged = 0
    for i, name in enumerate(names):
        first = i - i % ROBOTS_A_BUILDING
        held = fleet.nodes[name].global_map
        merged += held is not None and {member.robot for member in held.members} == set(names[first : first + ROBOTS_A_BUILDING])
    return merged / len(names)


def shown(row: Row) -> dict[str, object]:
    """The line of the table."""
    return {
        "robots": row.robots,
        "simulated s: meeting + steady (tick)": f"{row.meeting_s:.0f} + {row.steady_s:.0f} ({row.tick_s:g})",
        "meeting, a robot: pushed / heard / pulled kB": " / ".join(
            f"{size / 1e3:,.1f}" for size in (row.meeting_pushed_bytes, row.meeting_heard_bytes, row.meeting_pulled_bytes)
        ),
        "buildings whole": f"{100 * row.merged_share:.0f} %",
        "a minute: pushed": f"{row.pushed_messages:,.1f} messages, {row.pushed_bytes:,.0f} B",
        "heard": f"{row.heard_messages:,.0f} messages, {row.heard_bytes:,.0f} B",
        "pulled": f"{row.pulled_messages:,.1f} messages, {row.pulled_bytes:,.0f} B",
        "peers known": row.most_peers,
        "CPU s of the run": round(row.cpu_s, 1),
    }


def chart(rows: list[Row]) -> str:
    """Messages and bytes a robot and minute over the size of the fleet."""
    curves = {"heard, B": "heard_bytes", "pushed, B": "pushed_bytes", "heard, messages": "heard_messages"}
    curves |= {"pushed, messages": "pushed_messages"}
    series = {name: [(float(row.robots), max(0.1, getattr(row, field))) for row in rows] for name, field in curves.items()}
    return log_log_chart("What a fleet costs each robot", "robots", "a robot and minute, steady state", series)


def known_rows(file: Path | None) -> dict[int, Row]:
    """Rows of earlier runs, by size."""
    if file is None or not file.exists():
        return {}
    return {row["robots"]: Row(**row) for row in json.loads(file.read_text())}


def write(file: Path, text: str) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=[2, 10, 30, 100, 300, 1000])
    parser.add_argument("--json", type=Path, help="rows of earlier runs in it are kept: sizes may be run one by one")
    parser.add_argument("--svg", type=Path, default=_PICTURE)
    args = parser.parse_args()
    rows = known_rows(args.json)
    for size in args.sizes:
        rows[size] = measure(size)
        ordered = [row for _, row in sorted(rows.items())]
        if args.json is not None:
            write(args.json, json.dumps([asdict(row) for row in ordered], indent=1) + "\n")
        write(args.svg, chart(ordered))
        print(f"{size} robots: {rows[size].cpu_s:.0f} CPU s", file=sys.stderr, flush=True)
    print(markdown([shown(row) for _, row in sorted(rows.items())]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
