"""What the live page costs the robot that serves it: viewers at five events a second, who fetch every map that changed.

.venv/bin/python -m tests.bench.page_viewers [--viewers 20] [--seconds 20] [--json]

A process of its own serves a fleet of four robots, whose poses change at every event and whose maps once a second; here the
viewers do what a browser does.  CPU is that process's, less what it takes while nobody looks.
"""

from __future__ import annotations

import argparse
import http.client
import json
import os
import selectors
import socket
import subprocess
import sys
import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from agent.view.server import ViewServer
from protocol.features import FeatureMap
from protocol.geometry import SE2
from protocol.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from tests.bench.tables import markdown

ROBOTS = ("r1", "r2", "r3", "r4")
SIDE_CELLS = 400  # 20 m at 5 cm, as in the demo
HOST = "127.0.0.1"


class Fleet:
    """A status as large as a real one, with news in every call; maps that grow by a wall a second."""

    def __init__(self) -> None:
        cells = np.full((SIDE_CELLS, SIDE_CELLS), UNKNOWN, np.int8)
        cells[20:-20, 20:-20] = FREE
        for k in range(20, SIDE_CELLS - 20, 45):
            cells[k, 20:-20] = cells[20:-20, k] = OCCUPIED
        self._cells, self._calls = cells, 0

    def status(self) -> Mapping[str, Any]:
        self._calls += 1
        version = str(int(time.monotonic()))
        about = {"version": version, "width": SIDE_CELLS, "height": SIDE_CELLS, "resolution_m": 0.05, "origin": [0.0, 0.0, 0.0]}
        peer = {"state": "alive", "pair": "merged", "reason": "matched", "match_factor": 0.97, "known_m2": 120.0, "age_s": 0.4}
        attempt = {
            "peer": "r2", "status": "merged", "reason": "matched", "match_factor": 0.97, "overlap_m2": 55.0, "score": 31.0,
            "runner_up": 8.0, "T_ours_theirs": [1.0, 2.0, 0.5], "alternatives": [[3.0, 1.0, 0.1, 8.0]], "uptime_s": 12.0,
        }  # fmt: skip
        return {
            "robot": "r1", "group": list(ROBOTS), "root": "r1",
            "frames": {name: [1.0, 2.0, 0.5] for name in ROBOTS},
            "poses": {name: [self._calls % 97 * 0.1, 2.0, 0.5] for name in ROBOTS},
            "maps": dict.fromkeys(("global", *ROBOTS), about),
            "mapping": {"scans": self._calls},
            "peers": [peer | {"robot": name} for name in ROBOTS[1:]],
            "attempts": [attempt] * 20,
            "problems": [],
            "facts": {"scans": str(self._calls), "mapping": "tracking"},
        }  # fmt: skip

    def grid(self, name: str) -> tuple[str, OccupancyGrid] | None:
        return str(int(time.monotonic())), OccupancyGrid(self._cells, 0.05, SE2.identity())

    def features(self, name: str) -> FeatureMap | None:
        return None

    def metrics(self) -> str:
        return ""


def serve() -> None:
    """The robot's side: prints its port, then its CPU seconds whenever asked."""
    server = ViewServer(Fleet(), 0, HOST)
    server.start()
    print(server.url, flush=True)
    for _ in sys.stdin:
        print(time.process_time(), flush=True)
    server.close()


class Viewer:
    """One browser: an event stream, and the fleet's map whenever it changed."""

    def __init__(self, port: int) -> None:
        self.socket = socket.create_connection((HOST, port))
        self.socket.sendall(b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n")
        self.socket.setblocking(False)
        self.events = self.event_bytes = self.maps = self.map_bytes = 0
        self._port, self._rest, self._version = port, b"", ""

    def read(self) -> None:
        data = self.socket.recv(1 << 20)
        self.event_bytes += len(data)
        *events, self._rest = (self._rest + data).split(b"\n\n")
        for event in events:
            _, _, body = event.partition(b"data: ")
            if body:
                self.events += 1
                self._fetch(next(iter(json.loads(body).values())).get("maps", {}).get("global", {}).get("version", ""))

    def _fetch(self, version: str) -> None:
        if version and version != self._version:
            self._version = version
            connection = http.client.HTTPConnection(HOST, self._port)
            connection.request("GET", f"/map/global.png?v={version}")
            self.map_bytes += len(connection.getresponse().read())
            self.maps += 1
            connection.close()


def measure(viewers: int, seconds: float) -> dict[str, Any]:
    server = subprocess.Popen(
        [sys.executable, "-m", "tests.bench.page_viewers", "--serve"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert server.stdin is not None
    assert server.stdout is not None
    port = int(server.stdout.readline().rstrip("/\n").rpartition(":")[2])
    cpu_s = lambda: (server.stdin.write("?\n"), server.stdin.flush(), float(server.stdout.readline()))[2]  # type: ignore[union-attr]  # noqa: E731
    idle_s = -cpu_s()
    time.sleep(2.0)
    idle_s = (idle_s + cpu_s()) / 2.0
    selector = selectors.DefaultSelector()
    people = [Viewer(port) for _ in range(viewers)]
    for person in people:
        selector.register(person.socket, selectors.EVENT_READ, person)
    before_s, started_s = cpu_s(), time.monotonic()
    while time.monotonic() - started_s < seconds:
        for key, _ in selector.select(0.1):
            key.data.read()
    took_s = time.monotonic() - started_s
    spent_s = cpu_s() - before_s
    server.stdin.close()
    server.wait(10)
    return {
        "viewers": viewers,
        "seconds": round(took_s, 1),
        "events_per_s": round(sum(p.events for p in people) / viewers / took_s, 2),
        "maps_per_s": round(sum(p.maps for p in people) / viewers / took_s, 2),
        "event_bytes_per_s": round(sum(p.event_bytes for p in people) / viewers / took_s),
        "map_bytes_per_s": round(sum(p.map_bytes for p in people) / viewers / took_s),
        "cpu_percent": round(100 * (spent_s / took_s - idle_s), 2),
        "load": round(os.getloadavg()[0], 1),
    }


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--viewers", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.serve:
        serve()
        return
    found = measure(args.viewers, args.seconds)
    if args.json:
        print(json.dumps(found))
        return
    row = {
        "viewers": found["viewers"],
        "events/s each": found["events_per_s"],
        "maps/s each": found["maps_per_s"],
        "bytes/s each, events + maps": f"{found['event_bytes_per_s']} + {found['map_bytes_per_s']}",
        "CPU of the robot, % of a core": found["cpu_percent"],
    }
    print(markdown([row]))


if __name__ == "__main__":
    main()
