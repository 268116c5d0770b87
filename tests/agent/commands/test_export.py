"""`mapquilt export`: what a robot knows, in files that other tools open."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from agent.map_files import load_map
from agent.mapping.mapper import Mapper
from agent.mapping.options import MappingOptions
from agent.runtime.state import StateDirectory
from hw.readings import LaserScan, Odometry
from protocol.geometry import SE2
from protocol.grid import OccupancyGrid
from tests.agent.commands.conftest import FakeRobot, Run, floor_plan
from tests.agent.test_mcap_file import MESSAGE, records

StartRobot = Callable[..., FakeRobot]


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    """A state directory with the map of a square room seen from its middle."""
    mapper = Mapper(MappingOptions(particles=3), seed=1)
    angles = np.linspace(-np.pi, np.pi, 360, endpoint=False).astype(np.float32)
    ranges = (2.0 / np.maximum(abs(np.cos(angles)), abs(np.sin(angles)))).astype(np.float32)
    for i in range(3):
        mapper.add_odometry(Odometry(0.1 * i, 0.0, 0.0, 0.0))
        mapper.add_scan(LaserScan(0.1 * i, ranges, angles, 0.1, 20.0))
    assert StateDirectory(tmp_path / "state").save("mapper", mapper.checkpoint())
    return tmp_path / "state"


def test_what_was_saved_becomes_every_kind_of_file(run: Run, saved: Path, tmp_path: Path) -> None:
    ended = run("export", "--state-dir", saved, "--id", "r1", "-o", tmp_path / "out" / "v1.2")
    assert ended.code == 0, ended.err
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        f"v1.2.{s}" for s in ("mcap", "pgm", "png", "tum", "yaml")
    ]
    assert load_map(tmp_path / "out" / "v1.2.yaml").known_area_m2() > 0.5
    assert len((tmp_path / "out" / "v1.2.tum").read_text().splitlines()) == 3
    mcap = (tmp_path / "out" / "v1.2.mcap").read_bytes()
    assert sum(opcode == MESSAGE for opcode, _ in records(mcap)) == 5  # map, path, and the robot at three scans


def test_only_the_formats_that_were_asked_for(run: Run, saved: Path, tmp_path: Path) -> None:
    run("export", "--state-dir", saved, "-o", tmp_path / "x", "--formats", "png,tum")
    assert sorted(path.name for path in tmp_path.glob("x.*")) == ["x.png", "x.tum"]
    ended = run("export", "--state-dir", saved, "-o", tmp_path / "x", "--formats", "svg")
    assert (ended.code, ended.err) == (2, "mapquilt: export: unknown format 'svg'; choose from nav2, png, tum, mcap\n")


def test_without_anything_saved_it_says_so(run: Run, tmp_path: Path) -> None:
    ended = run("export", "--id", "r1", "-o", tmp_path / "x")
    assert ended.code == 4
    assert "no saved map of r1; give --id or --state-dir, or start the robot" in ended.err
    StateDirectory(tmp_path / "state").save("mapper", b"of another version")
    ended = run("export", "--id", "r1", "-o", tmp_path / "x", "--state-dir", tmp_path / "state")
    assert ended.code == 4
    assert "does not fit this program" in ended.err


def test_a_running_robot_is_asked_for_the_map_it_shares(run: Run, robot: StartRobot, tmp_path: Path) -> None:
    plan = floor_plan()
    robot("r1", maps={"r1": OccupancyGrid(plan.cells[:10], 0.05, SE2.identity()), "global": plan})
    ended = run("export", "--map", "global", "-o", tmp_path / "fleet")
    assert ended.code == 0, ended.err
    assert "no trajectory of 'global' was kept" in ended.err
    again = load_map(tmp_path / "fleet.yaml")
    assert np.array_equal(again.cells, plan.cells)
    assert again.origin == plan.origin
    assert b"r2/map" in (tmp_path / "fleet.mcap").read_bytes()
    run("export", "-o", tmp_path / "own")
    assert load_map(tmp_path / "own.yaml").height == 10
    ended = run("export", "--map", "r7", "-o", tmp_path / "x")
    assert (ended.code, ended.err) == (5, "mapquilt: r1 has no map 'r7'; it has r1, global\n")
