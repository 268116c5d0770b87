"""Commands run in the same process, robots answer on real sockets."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.cli import main
from agent.map_files import save_map
from agent.runtime.control import ControlError, ControlServer
from agent.runtime.packed_maps import packed_map
from protocol.geometry import SE2
from protocol.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

STATUS: dict[str, Any] = {
    "robot": "r1", "fleet": "mapquilt", "boot": "00", "uptime_s": 3725.0, "is_paused": False,
    "mapping": {"scans": 120, "scans_lost": 1, "odometry": 600, "cpu_ms_per_scan": 2.34, "revision": 9, "epoch": 0,
                "status": "tracking", "known_m2": 81.5, "particles": 20.1, "pose": [1.0, 2.0, 0.5], "pose_stamp_s": 7.0},
    "devices": [{"name": "lidar", "url": "ld06:/dev/ttyUSB0", "state": "running", "model": "LD06", "rate_hz": 10.02, "age_s": 0.1,
                 "points": 450, "coverage": 1.0, "readings": 120, "bad_frames": 0, "reconnects": 0, "error": ""}],
    "root": "r1", "composer": "r1", "group": ["r1", "r2"], "frames": {"r1": [0.0, 0.0, 0.0], "r2": [3.0, 4.0, 1.57]},
    "covariances": {}, "poses": {"r1": [1.0, 2.0, 0.5]},
    "peers": [{"robot": "r2", "state": "alive", "age_s": 0.2, "is_frozen": False, "known_m2": 60.0, "pair": "merged",
               "reason": "", "attempts": 3, "match_factor": 0.9612, "strikes": 0},
              {"robot": "r3\x1b[2J", "state": "lost", "age_s": 45.0, "is_frozen": False, "known_m2": 9.0, "pair": "no",
               "reason": "little common wall", "attempts": 1, "match_factor": None, "strikes": 0}],
    "edges": [{"a": "r1", "b": "r2", "match_factor": 0.96, "T_a_b": [0.0, 0.0, 0.0], "age_s": 125.0}],
    "merge_times": {"peers": 1, "p50_s": 4.2, "p90_s": 4.2, "max_s": 4.2},
    "global": {"digest": "ab", "author": "r1", "members": ["r1", "r2"], "known_m2": 130.2, "conflicting_cells": 12,
               "agreeing_cells": 3000},
    "maps": {}, "attempts": [],
    "network": {"profile": "lan", "security": "shared", "locators": [], "links": ["r2"], "sent_bytes": 1024, "served_bytes": 1024,
                "received_bytes": 512, "pulled_bytes": 0},
    "workers": [], "problems": ["wheels wheels:/dev/ttyACM0: no such port"], "has_estimate": True,
}  # fmt: skip


@dataclass
class Ended:
    """How a command ended."""

    code: int
    out: str
    err: str


Run = Callable[..., Ended]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Run:
    """`run("status", "--json")`: in an environment without any settings or robots but the test's own."""
    for name in ("RUNTIME_DIRECTORY", "STATE_DIRECTORY", "XDG_STATE_HOME", "XDG_CONFIG_HOME", "MAPQUILT_CONFIG", "NO_COLOR"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "run"))
    monkeypatch.setattr("agent.running.SERVICES", tmp_path / "services")

    def run_command(*words: object) -> Ended:
        try:
            code = main([str(word) for word in words])
        except SystemExit as end:  # argparse's own: --help, --version, a wrong flag
            code = int(end.code or 0)
        captured = capsys.readouterr()
        return Ended(code, captured.out, captured.err)

    return run_command


@dataclass
class FakeRobot:
    """A control socket with a status behind it; `heard` is what it was asked."""

    server: ControlServer
    heard: list[dict[str, Any]]


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[Callable[..., FakeRobot]]:
    """`robot("r1")` starts one."""
    started: list[ControlServer] = []

    def start(name: str, folder: Path | None = None, maps: dict[str, OccupancyGrid] | None = None, **status: Any) -> FakeRobot:
        heard: list[dict[str, Any]] = []

        def told(request: Any) -> dict[str, Any]:
            heard.append(dict(request))
            if request.get("peer") == "nobody":
                raise ControlError("no peer 'nobody'; known are r2")
            return {"message": f"did {request['command']}"}

        def map_of(request: Any) -> dict[str, Any]:
            return {"map": packed_map("0.1", (maps or {})[request["name"]])}

        commands = dict.fromkeys(("pause", "resume", "reset", "unmerge", "readmit", "save", "stop"), told)
        known = {**STATUS, "robot": name, "maps": {key: {} for key in maps or {}}, **status}
        handlers = {**commands, "map": map_of, "status": lambda _: {"status": known}}
        server = ControlServer((folder or tmp_path / "run" / "mapquilt") / f"{name}.sock", handlers)
        server.start()
        started.append(server)
        return FakeRobot(server, heard)

    yield start
    for server in started:
        server.close()


def floor_plan() -> OccupancyGrid:
    """Three unlike rooms, a corridor, a pillar and a niche: 20 x 12 m, nothing in it repeats."""
    cells = np.full((240, 400), FREE, np.int8)
    for y0, x0, y1, x1 in (
        (0, 0, 2, 400), (238, 0, 240, 400), (0, 0, 240, 2), (0, 398, 240, 400),  # outer walls
        (90, 0, 92, 130), (90, 160, 92, 400), (2, 190, 90, 192), (120, 0, 122, 60), (120, 90, 122, 300),
        (120, 340, 122, 400), (122, 140, 200, 142), (122, 280, 238, 282), (40, 330, 60, 360), (200, 60, 202, 120),
    ):  # fmt: skip
        cells[y0:y1, x0:x1] = OCCUPIED
    rows, cols = np.mgrid[:240, :400]
    distance = np.hypot(rows - 170, cols - 330)
    cells[(distance > 18) & (distance < 20)] = OCCUPIED
    cells[distance <= 18] = UNKNOWN
    return OccupancyGrid(cells, 0.05, SE2(-3.0, -2.0, 0.0))


@pytest.fixture
def office(tmp_path: Path) -> Path:
    """A map file of it."""
    return save_map(floor_plan(), tmp_path / "office")[0]
