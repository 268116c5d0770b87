"""`mapquilt sim`: a device appears where it was asked for, and nonsense is refused in one sentence."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from agent.cli import main
from agent.exits import OK, USAGE
from hw.device import open_lidar, open_wheels
from hw.readings import LaserScan, Odometry
from hw.sim.catalogue import BASES
from hw.sim.obedient import ObedientRobot
from hw.sim.pty_port import PtyLine
from hw.sim.world import open_world
from protocol.geometry import SE2
from tests.harness.waiting import first_reading, until


def test_a_served_lidar_and_its_wheels_can_be_opened_and_stop_on_sigterm(tmp_path: Path) -> None:
    room = tmp_path / "room.txt"
    room.write_text("0 0 4 0\n4 0 4 3\n4 3 0 3\n0 3 0 0\n")
    words = ["rplidar-c1", "--link", tmp_path / "lidar", "--also", f"wt1={tmp_path / 'wheels'}"]
    words += ["--also", f"roboclaw={tmp_path / 'claw'}", "--world", room, "--pose", "1,1,90", "--noise", "0"]
    process = subprocess.Popen([sys.executable, "-m", "agent", "sim", *map(str, words)], stdout=subprocess.PIPE, text=True)
    try:
        until(lambda: os.path.lexists(tmp_path / "claw"), 20.0, "the ports")
        with open_lidar(f"rplidar:{tmp_path / 'lidar'}") as lidar, open_wheels(f"wheels:{tmp_path / 'wheels'}") as wheels:
            scan = first_reading(lidar, lambda reading: isinstance(reading, LaserScan) and not reading.is_partial, 10.0)
            first_reading(wheels, lambda reading: isinstance(reading, Odometry), 5.0)
        ahead_m = scan.ranges_m[np.argmin(np.abs(scan.angles_rad))]
        left_m = scan.ranges_m[np.argmin(np.abs(scan.angles_rad - np.pi / 2))]
        assert (ahead_m, left_m) == (pytest.approx(2.0, abs=0.01), pytest.approx(1.0, abs=0.01))  # looking along y from (1, 1)
        process.send_signal(signal.SIGTERM)
        told, _ = process.communicate(timeout=10)
        assert process.returncode == OK
        assert f"rplidar:{tmp_path / 'lidar'}" in told
        assert f"'roboclaw:{tmp_path / 'claw'}?ticks=" in told  # as a shell takes it
        assert not os.path.lexists(tmp_path / "lidar")
    finally:
        process.kill()
        process.wait()


REFUSED = [
    (["nope"], "there are rplidar-a1"),
    (["ld06", "--pose", "1,2"], "x,y,degrees"),
    (["ld06", "--world", "moon"], "built-in world"),
    (["ld06", "--fault", "explode@1"], "kinds are"),
    (["ld06", "--also", "wt1"], "DEVICE=PATH"),
    (["ld06", "--pose", "-1,2"], "x,y,degrees"),
    (["ld06", "--pose", "1,nan,0"], "at most 500 m"),
    (["ld06", "--world", "office?sed=3"], "office?seed=3"),
    (["ld06", "--noise", "-1"], "from 0 to 10"),
    (["ld06", "--noise", "nan"], "from 0 to 10"),
    (["ld06", "--speed", "0"], "from 0.01 to 2"),
    (["ld06", "--seed", "-1"], "of at least 0"),
    (["ld06", "--seconds", "inf"], "of at least 0"),
]


@pytest.mark.parametrize(("words", "says"), REFUSED)
def test_what_cannot_be_served_is_said(words: list[str], says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sim", *words, "--link", str(tmp_path / "port")]) == USAGE
    assert says in capsys.readouterr().err


def test_a_link_in_a_folder_that_is_not_there_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sim", "ld06", "--link", str(tmp_path / "no" / "port"), "--world", "random"]) == USAGE
    assert "the folder must exist" in capsys.readouterr().err


def test_a_file_that_lies_where_the_link_should_be_is_not_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "port").write_text("precious")
    assert main(["sim", "ld06", "--link", str(tmp_path / "port"), "--world", "random"]) == USAGE
    assert "File exists" in capsys.readouterr().err
    assert (tmp_path / "port").read_text() == "precious"


def test_a_link_of_somebody_else_is_not_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "port").symlink_to("/dev/null")
    assert main(["sim", "ld06", "--link", str(tmp_path / "port"), "--seconds", "0"]) == USAGE
    assert "File exists" in capsys.readouterr().err
    assert (tmp_path / "port").readlink() == Path("/dev/null")


def test_two_devices_do_not_take_one_port_from_one_another(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    port = tmp_path / "port"
    assert main(["sim", "ld06", "--link", str(port), "--also", f"wt1={port}", "--seconds", "0"]) == USAGE
    assert "PATH of its own" in capsys.readouterr().err


def test_a_simulator_that_ends_leaves_the_link_of_the_one_that_took_over(tmp_path: Path) -> None:
    robot = ObedientRobot(open_world("random"), SE2(1, 1, 0))
    first, second = (PtyLine(BASES["wt1"].make(robot), tmp_path / "port") for _ in range(2))
    first.close()
    assert (tmp_path / "port").exists()
    second.close()
    assert not list(tmp_path.iterdir())
