"""Threat 40: one robot of three hears thousands of invented ones, each with the largest announcement that fits.

    .venv/bin/python -m tests.campaigns.strangers [--ids 2000] [--seed 1] [--json]

Invented robots beat and announce a map of 600 lines each, as somebody would who wants the peer table full, and answer no
question.  The three merge first, in the fleet's simulation; then the crowd speaks to one of them for 20 s.

Bars: the table holds at most `FleetOptions.max_peers`, nobody of the group is forgotten, the group stays whole.
"""

from __future__ import annotations

import argparse
import os
import random
import sys
import time

import numpy as np

from agent.fleet.coordinator import Coordinator
from agent.fleet.effects import Fetch
from agent.fleet.options import FleetOptions
from protocol.codec import decode, encode
from protocol.features import FeatureMap
from protocol.messages import NO_DIGEST, Beat, MapAnnouncement, MapVersion
from tests.bench.tables import print_row
from tests.fleet.groups import fleet_of, names
from tests.harness.processes import percentile, resident_mb

LINES, SECONDS, BEAT_S = 600, 20, 10.0


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ids", type=int, default=2_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args(argv)
    fleet = fleet_of(3, seed=args.seed)
    fleet.run_until(lambda: fleet.agrees(names(3)), 30.0)
    victim = fleet.nodes["r0"].coordinator
    assert victim is not None
    before_mb, heard_s, steps_s, asked = resident_mb(os.getpid()), [], [], 0
    rng, maps = random.Random(args.seed), np.random.default_rng(args.seed)
    for second in range(SECONDS):
        for i in rng.sample(range(args.ids), int(args.ids / BEAT_S)):
            heard_s.append(spent_s(victim, invented(i, second, maps), fleet.now_s))
        fleet.run(1.0)
        began_s = time.process_time()
        asked += sum(isinstance(effect, Fetch) for effect in victim.tick(fleet.now_s))
        steps_s.append(time.process_time() - began_s)
    known = {peer.robot for peer in victim.state(fleet.now_s).peers}
    figures = {
        "invented robots": args.ids,
        "messages": 2 * len(heard_s),
        "known": len(known),
        "of the group": len(known & set(names(3))),
        "group whole": fleet.agrees(names(3)),
        "RSS": f"+{resident_mb(os.getpid()) - before_mb:.0f} MB",
        "ms to hear one, p99": 1e3 * percentile(heard_s, 0.99),
        "ms a step, median": 1e3 * percentile(steps_s, 0.5),
        "ms a step, p99": 1e3 * percentile(steps_s, 0.99),
        "questions asked": asked,
    }
    print_row(figures, as_json=args.json)
    holds = figures["group whole"] and figures["of the group"] == 2 and len(known) <= FleetOptions().max_peers
    return 0 if holds else 1


def invented(i: int, second: int, maps: np.random.Generator) -> list[bytes]:
    """What one of the crowd says: that it is there, and that its map is worth a look."""
    robot, version = f"x{i:05}", MapVersion(i + 1, second + 1, (i * SECONDS + second).to_bytes(16, "little"))
    features = FeatureMap(lines=maps.uniform(1.0, 15.0, (LINES, 6)).astype(np.float32))
    beat = Beat(robot, i, second + 1, 1.0, BEAT_S, version, NO_DIGEST, NO_DIGEST, known_area_m2=900.0)
    return [encode(beat), encode(MapAnnouncement(robot, i, version, 0.05, 900.0, 100_000, features))]


def spent_s(victim: Coordinator, words: list[bytes], now_s: float) -> float:
    """CPU seconds to hear all of it; what it asks in return stays unanswered."""
    began_s = time.process_time()
    for word in words:
        victim.on_message(decode(word), now_s)
    return time.process_time() - began_s


if __name__ == "__main__":
    sys.exit(main())
