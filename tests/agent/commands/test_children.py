"""Robots as children: what belongs to this machine's own robot is not theirs."""

from __future__ import annotations

from pathlib import Path

from agent.commands.children import child_environment
from agent.config import Config
from agent.config_sources import load_config


def test_settings_of_the_robot_that_is_installed_here_do_not_reach_a_demo(tmp_path: Path) -> None:
    mine = tmp_path / "mapquilt" / "config.toml"
    mine.parent.mkdir()
    mine.write_text('[fleet]\nsecurity = "shared"\n')
    here = {"XDG_CONFIG_HOME": str(tmp_path)}
    assert load_config(environ=here).config.fleet.security == "shared"
    assert load_config(environ=here | child_environment(tmp_path)).config.fleet == Config().fleet
