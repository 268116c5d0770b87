"""`mapquilt localize`: the kidnapped robot finds itself, or is told that it cannot."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from agent.map_files import save_map
from protocol.geometry import SE2
from protocol.grid import FREE, OccupancyGrid
from tests.agent.commands.conftest import FakeRobot, Run, floor_plan


def test_a_part_is_found_in_the_whole(run: Run, office: Path, tmp_path: Path) -> None:
    local = floor_plan()
    part = OccupancyGrid(np.ascontiguousarray(local.cells[:, 150:]), 0.05, SE2(100.0, 50.0, 0.7))
    save_map(part, tmp_path / "part")
    ended = run("localize", tmp_path / "part.yaml", office, "--json", "-o", tmp_path / "where.png")
    assert ended.code == 0
    found = json.loads(ended.out)
    T_expected = local.origin @ SE2(7.5, 0.0, 0.0) @ part.origin.inverse()
    got = SE2(found["x"], found["y"], found["theta"])
    corner = part.origin.apply([(0.0, 0.0)])
    assert np.hypot(*(got.apply(corner) - T_expected.apply(corner))[0]) < 0.05
    assert got.theta_rad == pytest.approx(T_expected.theta_rad, abs=math.radians(0.3))
    assert found["match_factor"] > 0.95
    assert cv2.imread(str(tmp_path / "where.png")) is not None


def test_what_is_not_there_is_not_found(run: Run, office: Path, tmp_path: Path) -> None:
    save_map(OccupancyGrid(np.full((100, 100), FREE, np.int8), 0.05), tmp_path / "hall")
    ended = run("localize", tmp_path / "hall.yaml", office)
    assert ended.code == 1
    assert ended.out.startswith("not found: hall.yaml in office.yaml: ")
    assert json.loads(run("localize", tmp_path / "hall.yaml", office, "--json").out)["found"] is False


def test_the_running_robot_is_told_where_it_is(run: Run, office: Path, robot: Callable[..., FakeRobot]) -> None:
    plan = floor_plan()
    own = OccupancyGrid(plan.cells, 0.05, SE2(0.0, 0.0, 0.0))  # its frame begins where it woke up
    robot("r1", maps={"r1": own}, poses={"r1": [1.0, 2.0, 0.5]})
    found = json.loads(run("localize", office, "--json").out)
    assert (found["robot"]["x"], found["robot"]["y"]) == pytest.approx((-2.0, 0.0), abs=0.05)
    assert "the robot is at x -2.0" in run("localize", office).out


def test_a_robot_without_a_map_cannot_be_found(run: Run, office: Path, robot: Callable[..., FakeRobot]) -> None:
    robot("r1")
    ended = run("localize", office)
    assert (ended.code, ended.err) == (5, "mapquilt: r1 has no map yet; drive it a little and ask again\n")
