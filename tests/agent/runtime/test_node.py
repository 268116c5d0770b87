"""How a robot's process ends, whatever its threads are at."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import pytest

from agent.config_sources import load_config
from agent.fleet.effects import Fetch
from agent.runtime.network import NetworkSettings
from agent.runtime.node import Node
from tests.harness.rehearsal import Line
from tests.harness.waiting import until


class SilentLine(Line):
    """A network on which nobody answers."""

    def __init__(self, settings: NetworkSettings, *_: object) -> None:
        super().__init__(settings, lambda key: None)
        self.is_waiting = threading.Event()

    def open(self) -> None:
        """It is always there."""

    def locators(self) -> list[str]:
        return ["nowhere"]

    def links(self) -> list[str]:
        return []

    def receive(self, pending: bytes | None) -> bytes | None:
        """As long as a silent peer is waited for, unless the door is shut."""
        self.is_waiting.set()
        self.closed.wait(10.0)
        return None

    def stop_waiting(self) -> None:
        self.closed.set()

    def close(self) -> None:
        self.stop_waiting()


def robot(folder: Path) -> Node:
    flags = [("test", "robot.id", "r1"), ("test", "lidar.url", "sim:office?seed=3"), ("test", "mapping.particles", 2)]
    return Node(load_config(flags=flags, environ={}).config, folder, None, exchange=SilentLine)


def test_a_robot_that_waits_for_a_silent_peer_ends_at_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    node = robot(tmp_path)
    line: Any = node.fleet.exchange
    with node:
        node.fleet._bulk.put(Fetch(1, "r2", "map/coarse", is_bulk=True))
        assert line.is_waiting.wait(10.0)
    assert "left behind" not in caplog.text


def test_a_map_that_is_being_worked_on_is_not_saved(tmp_path: Path) -> None:
    """A loop may be closing: half of the path is bent, and half is not."""
    node, go_on, is_stuck = robot(tmp_path), threading.Event(), threading.Event()
    with node:
        until(lambda: node.map.scans > 0, 20.0, "the first scan")
        node.map.call(lambda: (is_stuck.set(), go_on.wait(10.0))[1])
        assert is_stuck.wait(10.0)
    assert node.state is not None
    assert node.state.load("mapper") is None
    go_on.set()


def test_a_map_that_was_reset_does_not_come_back_from_the_disk(tmp_path: Path) -> None:
    """The keeper may have asked for the old one a moment before."""
    node = robot(tmp_path)
    assert node.state is not None
    node.keeper.ask_for_checkpoint()
    node.reset_map()
    node.map.step()
    node.keeper.save_checkpoint()
    assert node.state.load("mapper") is None
