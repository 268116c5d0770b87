"""Replay as judge: the golden run, or any recording, through whole agents; the same bytes give the same decisions, to the bit.

.venv/bin/python -m tests.bench.golden                     the golden run, twice, against what was decided then
.venv/bin/python -m tests.bench.golden --make              decisions have changed on purpose: keep the new ones
.venv/bin/python -m tests.bench.golden --record            drive again: new bytes, new decisions
.venv/bin/python -m tests.bench.golden --carmen intel      a recording of ../shared/data cut in two, one half a robot
"""

from __future__ import annotations

import argparse
import sys
import time
from typing import Any

import cv2

from hw import sick_wire
from hw.carmen import read_recording
from hw.sim.devices import SickScanner
from hw.sim.replay import Replay, ReplayBoard, ReplayScans
from tests.bench.recordings import SHARED
from tests.bench.tables import print_row
from tests.harness import golden

CARMEN_SPEED = 4.0
SICK = f"sick:recorded?baud={SickScanner.baud}&rate={SickScanner.baud}"
SAID = {
    True: "as in the golden run, to the bit",
    False: "decided as in the golden run, but not all is the same to the bit",
    None: "decided as in the golden run, which had another processor or other libraries",
}
WHEELS = "wheels:recorded?v_max=50"


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--make", action="store_true")
    parser.add_argument("--record", action="store_true")
    parser.add_argument("--carmen", metavar="NAME")
    parser.add_argument("--particles", type=int, default=golden.PARTICLES)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args(argv)
    cv2.setNumThreads(1)
    if args.record:
        golden.FOLDER.mkdir(exist_ok=True)
        golden.DEVICES.write_bytes(golden.written(golden.drive()))
    run = carmen(args.carmen) if args.carmen else golden.read(golden.DEVICES)
    figures, robots = replayed(run, args.particles)
    print_row(figures, as_json=args.json)
    if args.carmen:
        return 0 if figures["to the bit"] else 1
    if args.make or args.record:
        golden.keep(robots)
    found = golden.differences(golden.kept(), robots)
    print("\n".join(found) or SAID[golden.is_to_the_bit(golden.kept(), robots)], file=sys.stderr)
    return 1 if found or not figures["to the bit"] else 0


def carmen(name: str) -> golden.Run:
    """Two halves of a recording, driven at the same time by two robots with a SICK and a WT1 board."""
    recording = read_recording(SHARED / "data" / "carmen" / f"{name}.log.gz")
    replays = {f"robot-{i}": Replay(recording.part(i, 2), CARMEN_SPEED) for i in (1, 2)}
    devices: dict[tuple[str, str], Any] = {}
    for robot, replay in replays.items():
        replay.begin(golden.FIRST_S)
        devices[robot, "lidar"] = scanner = SickScanner(ReplayScans(replay))
        scanner.receive(sick_wire.encode(sick_wire.CONTINUOUS), golden.FIRST_S)
        devices[robot, "wheels"] = ReplayBoard(replay)
    seconds = max(replay.duration_s for replay in replays.values())
    urls = {key: SICK if key[1] == "lidar" else WHEELS for key in devices}
    return golden.Run(urls, list(golden.emitted(devices, seconds)))


def replayed(run: golden.Run, particles: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """All robots together twice, and each alone with what it heard."""
    started = time.process_time()
    first, heard = golden.replay_all(run, particles)
    together_s = time.process_time() - started
    second, _ = golden.replay_all(run, particles)
    alone = {name: golden.replay_alone(run, name, heard[name], particles) for name in run.robots}
    robots = golden.summary(first.values())
    is_same = all(first[n].digest() == second[n].digest() == alone[n].digest() for n in run.robots)
    decisions = [decision for robot in robots.values() for decision in robot["decisions"]]
    figures = {
        "device bytes": sum(len(portion.data) for portion in run.portions),
        "seconds recorded": round(run.portions[-1].now_s - run.portions[0].now_s, 1),
        "scans": sum(robot["scans"] for robot in robots.values()),
        "decisions": len(decisions),
        "merged": sum(decision.get("status") == "merged" for decision in decisions),
        "in one map": max(len(robot["together"]) for robot in robots.values()),
        "CPU s a replay": round(together_s, 1),
        "to the bit": is_same,
    }
    return figures, robots


if __name__ == "__main__":
    raise SystemExit(main())
