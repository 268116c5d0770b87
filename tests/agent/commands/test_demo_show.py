"""What the demo says while it runs, and where it believes the robots are."""

from __future__ import annotations

import argparse
from typing import Any

import pytest

from agent.commands.demo_show import Show
from protocol.geometry import SE2


class NoFleet:
    agents = ()


def status(robot: str, root: str, frames: dict[str, list[float]]) -> dict[str, Any]:
    mapping = {"pose": [1.0, 0.0, 0.0], "scans": 7}
    return {"robot": robot, "root": root, "group": sorted(frames), "frames": frames, "mapping": mapping, "peers": []}


def show(*statuses: dict[str, Any]) -> Show:
    shown = Show(argparse.Namespace(quiet=True), NoFleet())  # type: ignore[arg-type]
    shown.statuses = list(statuses)
    return shown


def test_a_robot_that_lost_sight_of_the_others_is_where_the_others_see_it() -> None:
    best = status("a", "a", {"a": [0.0, 0.0, 0.0], "b": [5.0, 0.0, 0.0], "c": [0.0, 3.0, 0.0]})
    alone = status("b", "b", {"b": [0.0, 0.0, 0.0]})
    with_us = status("c", "a", best["frames"] | {"c": [0.0, 3.1, 0.0]})
    stranger = status("d", "d", {"d": [0.0, 0.0, 0.0]})
    poses = show(best, alone, with_us, stranger).poses_global(best)
    assert poses == {"a": SE2(1.0, 0.0, 0.0), "b": SE2(6.0, 0.0, 0.0), "c": SE2(1.0, 3.1, 0.0)}


def test_where_lines_stay_there_are_few_however_long_a_look_takes(capsys: pytest.CaptureFixture[str]) -> None:
    shown = show(status("a", "a", {"a": [0.0, 0.0, 0.0]}))
    shown.args.quiet = False
    for elapsed_s in (0.7, 1.3, 7.7, 9.1, 14.9):
        shown.progress(elapsed_s)
    assert [line.split()[0] for line in capsys.readouterr().err.splitlines()] == ["0.7", "7.7", "14.9"]
