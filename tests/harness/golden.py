"""The golden run: two robots in one office, their devices' bytes as they came, and what was decided then.

`python -m tests.bench.golden` replays it, `--make` keeps new decisions, `--record` drives again.

Numbers are kept rounded, and compared within a tolerance: other processors round otherwise.  The digest of all that was drawn,
decided and said is kept, too: with the processor and the libraries of the golden run it tells whether a change changed anything.
"""

from __future__ import annotations

import hashlib
import json
import lzma
import platform
import re
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from agent.config import Config, FleetConfig, LidarConfig, MappingConfig, RobotConfig
from hw.device import build_driver
from hw.sim.catalogue import BASES, LIDARS
from hw.sim.robot import SimulatedRobot
from hw.sim.sight import Sight
from hw.sim.world import open_world
from hw.urls import parse_url
from tests.harness.rehearsal import Heard, Rehearsal, Tape, Wire

FOLDER = Path(__file__).resolve().parents[1] / "agent/runtime/golden"
DEVICES, DECISIONS = FOLDER / "devices.xz", FOLDER / "decisions.json"
TURN_S, LATE_S = 0.1, 0.1  # a scan is looked at when the odometry of its last beam has come
READ_S = 0.05  # a port is read this often
FIRST_S = 1.0  # when recorded time begins
PARTICLES = 12  # fewer than a robot has: replays are part of the default tests
KEPT_FACTS = ("peer", "purpose", "status", "reason")
TOLERANCE = {"match_factor": 0.02, "x_m": 0.1, "y_m": 0.1, "theta_rad": 0.02, "overlap_m2": 5.0}
PACKED = struct.Struct("<BdI")


@dataclass(frozen=True, slots=True)
class Portion:
    """One read of one robot's device."""

    robot: str
    device: str
    now_s: float
    data: bytes


@dataclass(frozen=True, slots=True)
class Run:
    """A recorded run: the URL of every robot's devices, and what came from them in the order of time."""

    urls: dict[tuple[str, str], str]
    portions: list[Portion]

    @property
    def robots(self) -> list[str]:
        return sorted({robot for robot, _ in self.urls})


# Driving.


def drive(world: str = "office?seed=3", seconds: float = 12.0, seed: int = 5, spacing_m: float = 2.0) -> Run:
    """Two simulated robots that start in one room."""
    place = open_world(world)
    starts = place.start_poses(2, seed, spacing_m)
    devices: dict[tuple[str, str], Any] = {}
    for i, start in enumerate(starts):
        robot = SimulatedRobot(place, start, seed + i)
        robot.begin()
        devices[f"robot-{i + 1}", "lidar"] = LIDARS["ld06"][0](Sight(robot, seed=seed + i))
        devices[f"robot-{i + 1}", "wheels"] = BASES["wt1"].make(robot)
    urls = {(robot, device): "ld06:recorded" if device == "lidar" else "wheels:recorded" for robot, device in devices}
    return Run(urls, list(emitted(devices, seconds)))


def emitted(devices: Mapping[tuple[str, str], Any], seconds: float) -> Iterator[Portion]:
    """What the devices send, read by read."""
    for step in range(round(seconds / READ_S)):
        now_s = FIRST_S + step * READ_S
        for (robot, device), source in devices.items():
            if data := source.emit(now_s):
                yield Portion(robot, device, now_s, data)


def written(run: Run) -> bytes:
    """A run as a file."""
    keys = list(run.urls)
    head = json.dumps([[*key, run.urls[key]] for key in keys]).encode()
    body = b"".join(PACKED.pack(keys.index((p.robot, p.device)), p.now_s, len(p.data)) + p.data for p in run.portions)
    return lzma.compress(struct.pack("<I", len(head)) + head + body, preset=9)


def read(path: Path) -> Run:
    """A run from its file."""
    data = lzma.decompress(path.read_bytes())
    at = 4 + struct.unpack_from("<I", data)[0]
    urls = {(robot, device): url for robot, device, url in json.loads(data[4:at])}
    keys, portions = list(urls), []
    while at < len(data):
        key, now_s, length = PACKED.unpack_from(data, at)
        at += PACKED.size
        portions.append(Portion(*keys[key], now_s, data[at : at + length]))
        at += length
    return Run(urls, portions)


# Replaying.


def rehearsal(run: Run, robot: str, exchange: Any, particles: int = PARTICLES) -> Rehearsal:
    urls = {device: url for (name, device), url in run.urls.items() if name == robot}
    config = Config(
        RobotConfig(robot), LidarConfig(urls["lidar"]), mapping=MappingConfig(particles=particles), fleet=FleetConfig("golden")
    )
    drivers = {device: build_driver(parse_url(url), device) for device, url in urls.items()}
    return Rehearsal(config, drivers, exchange)


def replay_all(run: Run, particles: int = PARTICLES) -> tuple[dict[str, Rehearsal], dict[str, Heard]]:
    """All robots together; and what each heard from the others."""
    wire = Wire()
    robots = {name: rehearsal(run, name, wire.exchange, particles) for name in run.robots}
    for now_s, portions in turns(run.portions):
        for portion in portions:
            robots[portion.robot].sense(portion.device, portion.now_s, portion.data)
        for name, robot in robots.items():
            wire.now_s = now_s + after_s(run, name)
            robot.turn(wire.now_s)
    return robots, wire.heard


def replay_alone(run: Run, name: str, heard: Heard, particles: int = PARTICLES) -> Rehearsal:
    """One robot, from its devices' bytes and from what it heard of the others."""
    tape = Tape(heard)
    robot = rehearsal(run, name, tape.exchange, particles)
    for now_s, portions in turns(run.portions):
        for portion in portions:
            if portion.robot == name:
                robot.sense(portion.device, portion.now_s, portion.data)
        tape.play_until(now_s + after_s(run, name))
        robot.turn(now_s + after_s(run, name))
    return robot


def after_s(run: Run, name: str) -> float:
    """Robots take their turns one after the other: what one says, the next hears in the same turn."""
    return run.robots.index(name) * TURN_S / 100


def turns(portions: Sequence[Portion]) -> Iterator[tuple[float, list[Portion]]]:
    """What has come at each turn: wheels as they come, scans a moment later."""
    waiting = sorted(portions, key=due_s)
    at, now_s = 0, due_s(waiting[0])
    while at < len(waiting):
        now_s += TURN_S
        came = []
        while at < len(waiting) and due_s(waiting[at]) < now_s:
            came.append(waiting[at])
            at += 1
        yield now_s, came


def due_s(portion: Portion) -> float:
    return portion.now_s + (LATE_S if portion.device == "lidar" else 0.0)


# Judging.


def summary(robots: Iterable[Rehearsal]) -> dict[str, Any]:
    """What is kept of a run."""
    return {robot.node.robot: of_one(robot) for robot in robots}


def of_one(robot: Rehearsal) -> dict[str, Any]:
    global_map, newest = robot.node.fleet.global_map, robot.node.map.newest
    return {
        "digest": robot.digest(),
        "decisions": [rounded(decision) for decision in robot.decisions()],
        "scans": robot.node.map.scans,
        "known_m2": round(newest.grid.known_area_m2(), 1) if newest else 0.0,
        "together": [member.robot for member in global_map.members] if global_map else [],
        "edges": [f"{edge.robot_a} {edge.robot_b}" for edge in robot.node.fleet.state().edges],
    }


def rounded(decision: dict[str, Any]) -> dict[str, Any]:
    """Its words, and those numbers that may not wander."""
    words = {name: decision[name] for name in ("event", *KEPT_FACTS) if name in decision}
    numbers = decision | dict(zip(("x_m", "y_m", "theta_rad"), decision.get("T_ours_theirs") or (), strict=False))
    return words | {name: round(numbers[name], 3) for name in TOLERANCE if isinstance(numbers.get(name), float)}


def keep(robots: dict[str, Any]) -> None:
    """These decisions are the golden ones from now on."""
    DECISIONS.write_text(json.dumps({"machine": machine(), "robots": robots}, indent=1) + "\n")


def kept() -> dict[str, Any]:
    """The golden decisions."""
    found: dict[str, Any] = json.loads(DECISIONS.read_text())
    return found


def differences(golden: dict[str, Any], now: dict[str, Any]) -> list[str]:
    """What is not as it was."""
    found = []
    for robot, before in golden["robots"].items():
        after = now[robot]
        pairs = list(zip(before["decisions"], after["decisions"], strict=False))
        if len(before["decisions"]) != len(after["decisions"]):
            found.append(f"{robot}: {len(after['decisions'])} decisions, {len(before['decisions'])} before")
        found += [f"{robot}: decided {b}, before {a}" for a, b in pairs if not is_same(a, b)]
        found += [f"{robot}: {k} {after[k]}, before {before[k]}" for k in ("scans", "together", "edges") if after[k] != before[k]]
    return found


def is_to_the_bit(golden: dict[str, Any], now: dict[str, Any]) -> bool | None:
    """Whether all that was drawn, decided and said is the same; None: not to be expected, on this processor."""
    if golden["machine"] != machine():
        return None
    return all(golden["robots"][robot]["digest"] == now[robot]["digest"] for robot in now)


def is_same(a: dict[str, Any], b: dict[str, Any]) -> bool:
    words = {name for name in a if name not in TOLERANCE} | {name for name in b if name not in TOLERANCE}
    numbers = [name for name in TOLERANCE if name in a or name in b]
    return all(a.get(n) == b.get(n) for n in words) and all(
        n in a and n in b and abs(a[n] - b[n]) <= TOLERANCE[n] for n in numbers
    )


def machine() -> str:
    """What floating point depends on: the processor's abilities, and the libraries."""
    text = Path("/proc/cpuinfo").read_text() if Path("/proc/cpuinfo").exists() else ""
    flags = re.search(r"(?m)^(flags|Features)\s*:\s*(.*)$", text)
    abilities = hashlib.sha256((flags[2] if flags else "").encode()).hexdigest()[:16]
    return f"{platform.machine()} {abilities} numpy {np.__version__} opencv {cv2.__version__}"
