"""`mapquilt map`: a recording of a drive through a known room becomes that room."""

from __future__ import annotations

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from agent.map_files import load_map
from protocol.geometry import SE2
from protocol.grid import OCCUPIED
from tests.agent.commands.conftest import Run

ROOM_M = (6.0, 4.0)  # corners at the origin and here
BEAMS = 180


def ranges_m(pose: SE2) -> np.ndarray:
    """What a LIDAR looking half around sees in the empty room."""
    angles = pose.theta_rad - math.pi / 2 + math.pi / BEAMS * np.arange(BEAMS) + 1e-9
    along_x, along_y = np.cos(angles), np.sin(angles)
    to_x = np.maximum(-pose.x_m / along_x, (ROOM_M[0] - pose.x_m) / along_x)  # never exactly along an axis: angles are floats
    to_y = np.maximum(-pose.y_m / along_y, (ROOM_M[1] - pose.y_m) / along_y)
    return np.minimum(to_x, to_y)


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    """A CARMEN log: 2 m forward, then once around, with odometry that is 2 % short."""
    poses = [SE2(1.5 + 0.1 * i, 2.0, 0.0) for i in range(21)]
    poses += [SE2(3.5, 2.0, math.radians(9 * i)) for i in range(1, 41)]
    lines = []
    for i, pose in enumerate(poses):
        before = poses[max(i - 1, 0)]
        step = before.inverse() @ pose
        odom = before @ SE2(0.98 * step.x_m, step.y_m, step.theta_rad)
        at, place = f"{0.2 * i:.3f}", f"{pose.x_m} {pose.y_m} {pose.theta_rad}"
        lines.append(f"ODOM {odom.x_m} {odom.y_m} {odom.theta_rad} 0 0 0 {at} host {at}")
        lines.append(f"FLASER {BEAMS} {' '.join(f'{r:.3f}' for r in ranges_m(pose))} {place} {place} {at} host {at}")
    log = tmp_path / "drive.clf"
    log.write_text("\n".join(lines) + "\n")
    return log


def test_a_log_becomes_a_map_a_picture_and_a_trajectory(run: Run, drive: Path, tmp_path: Path) -> None:
    ended = run("map", drive, "-o", tmp_path / "out" / "room", "--json", "--particles", "5")
    assert ended.code == 0, ended.err
    figures = json.loads(ended.out)
    assert (figures["scans"], figures["scans_placed"], figures["begun_anew"]) == (61, 61, 0)
    assert figures["distance_m"] == pytest.approx(2.2, abs=0.4)  # turning on the spot is not quite on the spot
    written = {path.suffix for path in (tmp_path / "out").iterdir()}
    assert written == {".yaml", ".pgm", ".png", ".tum"}

    grid = load_map(tmp_path / "out" / "room.yaml")
    walls = SE2(1.5, 2.0, 0.0).apply(grid.points_of(np.argwhere(grid.cells == OCCUPIED)))  # the map begins where the robot began
    to_wall = np.minimum(
        np.minimum(abs(walls[:, 0]), abs(walls[:, 0] - ROOM_M[0])), np.minimum(abs(walls[:, 1]), abs(walls[:, 1] - ROOM_M[1]))
    )
    assert len(walls) > 300
    assert (to_wall < 0.1).mean() > 0.99
    assert grid.known_area_m2() == pytest.approx(24.0, abs=2.0)

    last = [float(word) for word in (tmp_path / "out" / "room.tum").read_text().splitlines()[-1].split()]
    assert last[1:3] == pytest.approx([2.0, 0.0], abs=0.05)
    assert cv2.imread(str(tmp_path / "out" / "room.png")) is not None


def test_the_same_log_and_seed_give_the_same_files(run: Run, drive: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        run("map", drive, "-o", tmp_path / name, "--particles", "5", "--seed", "4", "-q")
    for suffix in (".pgm", ".tum"):
        assert (tmp_path / "a").with_suffix(suffix).read_bytes() == (tmp_path / "b").with_suffix(suffix).read_bytes()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--particles", "0"], "--particles 0: expected 1 to 1000"),
        (["--resolution", "nan"], "--resolution nan: expected 0.01 to 1"),
        (["--mount", "1,2"], "expected x,y,degrees"),
        (["--mount", "1,2,inf"], "expected x,y,degrees"),
    ],
)
def test_options_that_make_no_sense_are_refused(words: list[str], said: str, run: Run, drive: Path) -> None:
    ended = run("map", drive, *words)
    assert ended.code == 2
    assert said in ended.err


def test_what_is_no_log_is_told(run: Run, tmp_path: Path) -> None:
    (tmp_path / "x.log").write_text("hello\n")
    ended = run("map", tmp_path / "x.log")
    assert ended.code == 4
    assert "is this a CARMEN log?" in ended.err
