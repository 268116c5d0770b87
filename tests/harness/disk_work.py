"""All that a robot does with its disk, as a script: sixty seconds of its life, without threads and without waiting.

It finds its map of the last run, maps on, saves now and then, writes records, rotates their file, forgets its map when told
to, and saves a last time.  Whatever the disk does meanwhile must be said in `problems`, and be over when the disk is well.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from unittest import mock

import numpy as np

from agent.commands.report import RECORD_FILES, read_records
from agent.config import Config, LidarConfig, MappingConfig, RobotConfig
from agent.fleet.effects import Note
from agent.runtime import problems as told
from agent.runtime import records
from agent.runtime.node import Node
from agent.runtime.state import StateDirectory
from hw.readings import LaserScan
from tests.harness.failing_disk import FailingDisk

SECONDS, SAVE_EVERY_S, RESET_AT_S = 60, 5, 32
RECORDS_SEEN = 15  # rotation keeps at least so many
CONFIG = Config(RobotConfig("r1"), LidarConfig("sim:office?seed=3"), mapping=MappingConfig(particles=1, resolution_m=0.2))


def scan(number: int) -> LaserScan:
    """A square room of four metres, seen from its middle."""
    angles = np.linspace(-np.pi, np.pi, 90, endpoint=False, dtype=np.float32)
    ranges = 2.0 / np.maximum(np.abs(np.cos(angles)), np.abs(np.sin(angles)))
    return LaserScan(1.0 + number, ranges.astype(np.float32), angles, 0.05, 10.0)


@dataclass(frozen=True, slots=True)
class Life:
    """How the minute went: what was not as it should be, and the map that was saved last."""

    wrong: list[str]
    saved: bytes


def live(folder: Path, disk: FailingDisk, heal_at_s: int = SECONDS, before: Life | None = None) -> Life:
    """A minute, after another one in the same place or as the first."""
    with mock.patch.object(records, "MAX_FILE_BYTES", 2000):
        node = Node(CONFIG, folder, None)
        node.map.publish()
        wrong = []
        if before is not None and node.map.mapper.checkpoint() != before.saved and not problems(node):
            wrong.append("the map of the last run is gone, and nothing is said")
        first = 1000 if before is not None else 0  # records of two lives bear different numbers
        for second in range(SECONDS):
            if second == heal_at_s:
                disk.heal()
            wrong += _second(node, folder, second, first, disk)
        disk.heal()
        node.records.add(Note("merge-attempt", {"peer": "r2", "number": first + SECONDS}))
        saved = _map_and_save(node, SECONDS)
    wrong += [f"the disk is well, and still: {problem}" for problem in problems(node)]
    return Life(wrong + missing(folder, saved, first + SECONDS), saved)


def _second(node: Node, folder: Path, second: int, first: int, disk: FailingDisk) -> list[str]:
    """What failed is said, or nothing came of it."""
    failures = disk.failures
    node.records.add(Note("merge-attempt", {"peer": "r2", "number": first + second}))
    is_said = bool(problems(node))
    saved = _map_and_save(node, second) if second % SAVE_EVERY_S == 0 else None
    if second == RESET_AT_S:
        node.reset_map()
    if disk.failures == failures or is_said or problems(node):
        return []
    with disk.unwatched():
        return [f"{disk.failed[-1]} failed, nothing is said, and {what}" for what in missing(folder, saved, first + second)]


def _map_and_save(node: Node, second: int) -> bytes:
    made: list[bytes] = []
    node.readings.put(scan(second))
    node.keeper.ask_for_checkpoint()
    node.map.call(lambda: made.append(node.map.mapper.checkpoint()))
    node.map.step()
    node.keeper.save_checkpoint()
    return made[0]


def problems(node: Node) -> list[str]:
    """What the robot says of its disk."""
    said = told.problems(node, node.fleet.state())
    return [problem for problem in said if problem.startswith(("state", "records"))]


def missing(folder: Path, saved: bytes | None, last: int) -> list[str]:
    """The map that was saved is there, no sound file was set aside, and every record up to the last is on disk."""
    wrong = []
    if saved is not None and StateDirectory(folder).load("mapper") != saved:
        wrong.append("the map that was saved last is not on disk")
    if list(folder.glob("*.bad")):
        wrong.append("a sound file was set aside")
    numbers = {record["number"] for name in RECORD_FILES for record in read_records(folder / name)}
    if gaps := sorted(set(range(max(last - RECORDS_SEEN, last // 1000 * 1000), last + 1)) - numbers):
        wrong.append(f"records are missing: {gaps}")
    return wrong
