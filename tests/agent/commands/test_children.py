"""Robots as children: what belongs to this machine's own robot is not theirs."""

from __future__ import annotations

import os
from pathlib import Path

from agent.commands.children import AgentProcess, child_environment, niceness
from agent.config import Config
from agent.config_sources import load_config


def test_settings_of_the_robot_that_is_installed_here_do_not_reach_a_demo(tmp_path: Path) -> None:
    mine = tmp_path / "mapquilt" / "config.toml"
    mine.parent.mkdir()
    mine.write_text('[fleet]\nsecurity = "shared"\n')
    here = {"XDG_CONFIG_HOME": str(tmp_path)}
    assert load_config(environ=here).config.fleet.security == "shared"
    assert load_config(environ=here | child_environment(tmp_path)).config.fleet == Config().fleet


def test_a_crowd_of_robots_leaves_the_cores_to_its_devices(tmp_path: Path) -> None:
    assert niceness(1) == 0
    robot = AgentProcess("r1", ["--help"], tmp_path, niceness=niceness(100))
    try:
        assert os.getpriority(os.PRIO_PROCESS, robot.process.pid) > os.getpriority(os.PRIO_PROCESS, 0)
    finally:
        robot.stop()
