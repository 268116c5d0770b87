"""C8: three robots while a stranger floods them and two programs eat the processor: do they go on mapping?

    .venv/bin/python -m tests.campaigns.overload [--minutes 5] [--grids 1000] [--tiny 10000] [--hogs 2] [--json]

The flooder is a session of its own: map announcements of 16 KB at `--grids` a second in the names of two hundred invented
robots, each of a map that has just changed and may be pulled from it, and `--tiny` messages a second of a few bytes, garbage
among them, on the keys of the honest robots.  Watchdog datagrams are received as systemd would receive them.

Bars: scans lost at most 1 %, no watchdog gap above 2 s, resident memory at most 64 MB above that before the flood.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import os
import random
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from agent.runtime.exchange import Exchange
from agent.runtime.network import NetworkSettings
from protocol.channels import PUSHED_REGISTERS, push_register, robot_key
from protocol.codec import encode
from protocol.features import FeatureMap
from protocol.messages import NO_DIGEST, Beat, MapAnnouncement, MapVersion, Message
from tests.bench.tables import print_row
from tests.harness.fleet import Fleet
from tests.harness.processes import resident_mb

MAX_LOST_SHARE, MAX_GAP_S, MAX_GROWTH_MB = 0.01, 2.0, 64.0
INVENTED = 200
LINES = 560  # in an announcement: as much as one push may carry
TICK_S = 0.02
MERGE_WITHIN_S = 120.0


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--robots", type=int, default=3)
    parser.add_argument("--particles", type=int, default=30)
    parser.add_argument("--grids", type=int, default=1000, help="announcements a second")
    parser.add_argument("--tiny", type=int, default=10_000, help="small messages a second")
    parser.add_argument("--hogs", type=int, default=2)
    parser.add_argument("--flood", nargs=2, metavar=("LOCATOR", "FLEET"), help=argparse.SUPPRESS)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args(argv)
    if args.flood:
        flood(*args.flood, args)
        return 0
    figures = campaign(args)
    print_row(figures, as_json=args.json)
    is_well = figures["scans lost %"] <= 100 * MAX_LOST_SHARE and figures["longest watchdog gap s"] <= MAX_GAP_S
    return 0 if is_well and figures["MB more"] <= MAX_GROWTH_MB and figures["worker errors"] == 0 else 1


# The flooder, in a process of its own.


def flood(locator: str, fleet: str, args: argparse.Namespace) -> None:
    """Until killed: one line a second with what was sent."""
    rng = random.Random(1)
    words = [written(fleet, message) for number in range(INVENTED) for message in invented(number)]
    settings = NetworkSettings("stray", fleet=fleet, connect=(locator,))
    with Exchange(settings, lambda _: os.urandom(16_000), serve=robot_key(fleet, "ghost-1", "**")) as stray:
        grids = tiny = 0
        started_s = time.monotonic()
        while True:
            running_s = time.monotonic() - started_s
            while grids < args.grids * running_s:  # what was not said in time is said later
                stray.put(*rng.choice(words))
                grids += 1
            while tiny < args.tiny * running_s:
                register = rng.choice(PUSHED_REGISTERS).replace("*", "robot-1")
                stray.put(robot_key(fleet, f"robot-{rng.randint(1, 5)}", register), rng.randbytes(rng.randint(0, 40)))
                tiny += 1
            print(grids, tiny, flush=True)
            time.sleep(TICK_S)


def invented(number: int) -> list[Message]:
    """What a robot that does not exist says of its maps: three announcements, and a beat with the newest of them."""
    rng = np.random.default_rng(number)
    name, boot = f"ghost-{number}", number + 1
    maps = [MapVersion(1, revision, rng.bytes(16)) for revision in (1, 2, 3)]
    tables = [FeatureMap(lines=rng.uniform(0.1, 3.0, (LINES, 6)).astype(np.float32)) for _ in maps]
    said: list[Message] = [
        MapAnnouncement(name, boot, version, 0.05, 120.0, 9_000, table) for version, table in zip(maps, tables, strict=True)
    ]
    return [*said, Beat(name, boot, 1 + number, 1.0, 1.0, maps[-1], bytes(8), NO_DIGEST, known_area_m2=120.0)]


def written(fleet: str, message: Message) -> tuple[str, bytes]:
    return robot_key(fleet, message.robot, push_register(message)), encode(message)


@contextlib.contextmanager
def flooding(locator: str, fleet: str, args: argparse.Namespace) -> Iterator[list[str]]:
    """The flooder and the hogs; the lines that the flooder says."""
    words = [sys.executable, "-m", "tests.campaigns.overload", "--flood", locator, fleet]
    rates = ["--grids", str(args.grids), "--tiny", str(args.tiny)]
    flooder = subprocess.Popen([*words, *rates], stdout=subprocess.PIPE, text=True)
    hogs = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(args.hogs)]
    lines: list[str] = []
    assert flooder.stdout is not None
    reader = threading.Thread(target=lambda: lines.extend(flooder.stdout or ()), daemon=True)
    reader.start()
    try:
        yield lines
    finally:
        for process in (flooder, *hogs):
            process.kill()
            process.wait()
        reader.join(2.0)


# The robots.


class Watchdog:
    """What systemd would see of one robot: when its watchdog was fed."""

    def __init__(self, folder: Path, robot: str) -> None:
        self.path = folder / f"{robot}.notify"
        self.fed_s: list[float] = []
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(self.path))
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        while True:
            if b"WATCHDOG=1" in self._socket.recv(4096):
                self.fed_s.append(time.monotonic())

    def environment(self) -> dict[str, str]:
        return {"NOTIFY_SOCKET": str(self.path), "WATCHDOG_USEC": str(round(2e6 * MAX_GAP_S / 4))}

    def longest_gap_s(self, since_s: float, until_s: float) -> float:
        moments = [since_s, *(at_s for at_s in self.fed_s if since_s < at_s < until_s), until_s]
        return max(b - a for a, b in itertools.pairwise(moments))


def campaign(args: argparse.Namespace) -> dict[str, Any]:
    with Fleet() as fleet:
        stage = fleet.stage("office", robots=args.robots)
        dogs = {actor.name: Watchdog(fleet.folder, actor.name) for actor in stage.robots}
        for actor in stage.robots:
            few = ["--set", f"mapping.particles={args.particles}", "--no-state"]
            fleet.start(actor, arguments=few, environment=dogs[actor.name].environment())
        fleet.begin(stage)
        names = list(dogs)
        fleet.until(lambda: all(fleet.members(name) == sorted(names) for name in names), MERGE_WITHIN_S, "one map")
        pids = {name: fleet.agents[name].process.pid for name in names}
        before = {name: fleet.status(name)["mapping"] for name in names}
        calm_mb = {name: resident_mb(pid) for name, pid in pids.items()}
        growth_mb = 0.0
        started_s = time.monotonic()
        with flooding(fleet.agents[names[0]].ready["locators"][0], fleet.name, args) as lines:
            while time.monotonic() - started_s < 60 * args.minutes:
                growth_mb = max(growth_mb, *(resident_mb(pid) - calm_mb[name] for name, pid in pids.items()))
                time.sleep(0.5)
            ended_s = time.monotonic()
        fleet.until(lambda: all(fleet.status(name) for name in names), 20.0, "everybody answers")
        statuses = {name: fleet.status(name) for name in names}
    seconds = ended_s - started_s
    scans = sum(s["mapping"]["scans"] - before[name]["scans"] for name, s in statuses.items())
    lost = sum(s["mapping"]["scans_lost"] - before[name]["scans_lost"] for name, s in statuses.items())
    sent = [int(word) / seconds for word in (lines[-1].split() if lines else ["0", "0"])]
    return {
        "robots": args.robots,
        "seconds": seconds,
        "grids a second": sent[0],
        "tiny a second": sent[1],
        "heard a second, by one robot": max(s["network"]["received_messages"] for s in statuses.values()) / seconds,
        "hogs": args.hogs,
        "scans a second": scans / seconds / args.robots,
        "scans lost %": 100.0 * lost / max(1, scans + lost),
        "longest watchdog gap s": max(dog.longest_gap_s(started_s, ended_s) for dog in dogs.values()),
        "MB more": growth_mb,
        "worker errors": sum(worker["errors"] for s in statuses.values() for worker in s["workers"]),
        "still one map": all((s["global"] or {}).get("members") == sorted(names) for s in statuses.values()),
    }


if __name__ == "__main__":
    sys.exit(main())
