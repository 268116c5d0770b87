"""What keeps a robot from coming up is one sentence with a way out."""

from __future__ import annotations

from pathlib import Path

import pytest

from agent.commands.run import make_node, running
from agent.config_sources import load_config
from agent.exits import USAGE, CommandError


def test_a_certificate_that_is_missing_is_said_with_the_command_that_makes_it(tmp_path: Path) -> None:
    settings = {"robot.id": "r1", "lidar.url": "sim:office", "fleet.security": "mtls", "fleet.certificates": str(tmp_path)}
    config = load_config(flags=[("test", name, value) for name, value in settings.items()], environ={}).config
    with pytest.raises(CommandError, match=r"ca\.pem.*mapquilt fleet enroll r1") as said, running(make_node(config, None)):
        pass
    assert said.value.code == USAGE
