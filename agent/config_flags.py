"""The flags that set a setting: one table, shared by every command that starts or inspects a robot.

add_config_arguments(parser)
loaded = load_from(args)        # .config, .origins
"""

from __future__ import annotations

import argparse
from typing import Any

from agent.config import ConfigError
from agent.config_sources import Loaded, assignment, load_config
from agent.exits import USAGE, CommandError

FLAGS: tuple[tuple[str, str, str, str], ...] = (  # flag, setting, placeholder, help
    ("--id", "robot.id", "ID", "this robot's name, unique in the fleet (default: the host name)"),
    ("--lidar", "lidar.url", "URL", "rplidar:/dev/ttyUSB0, ld06:/dev/ttyUSB1, sim:office?seed=3, log:run.clf, replay:FILE"),
    ("--wheels", "wheels.url", "URL", "wheels:/dev/ttyACM0, create2:..., kobuki:..., sim:..., log:..."),
    ("--fleet", "fleet.name", "NAME", "robots of other fleets are not seen"),
    ("--profile", "fleet.profile", "NAME", "loopback, lan, radio or infrastructure"),
    ("--listen", "fleet.listen", "ENDPOINT", "where others may dial in, as tcp/0.0.0.0:7447 (repeatable)"),
    ("--connect", "fleet.connect", "ENDPOINT", "a peer or router to dial (repeatable)"),
    ("--security", "fleet.security", "LEVEL", "open, shared or mtls"),
    ("--prior", "fleet.priors", "MAP.yaml", "a given map to find oneself in (repeatable)"),
    ("--state-dir", "state.dir", "DIR", "where the map is kept between starts"),
    ("--view-host", "view.host", "HOST", "address of the live page (default: 127.0.0.1)"),
    ("--view-port", "view.port", "PORT", "port of the live page (default: 8080)"),
    ("--seed", "mapping.seed", "N", "seed of the particle filter"),
)
NETWORK = ("fleet.name", "fleet.profile", "fleet.listen", "fleet.connect", "fleet.security")
LISTS = ("fleet.listen", "fleet.connect", "fleet.priors")


def add_config_arguments(parser: argparse.ArgumentParser, *of: str) -> None:
    """Flags for the settings that a command heeds: `"fleet"` a section, `"robot.id"` one of them; none named: all."""
    group = parser.add_argument_group("settings", "the file is read first, then MAPQUILT_SECTION__KEY variables, then these")
    group.add_argument("--config", metavar="FILE", help="settings file (default: ~/.config/mapquilt/config.toml)")
    for flag, setting, placeholder, text in FLAGS:
        if of and setting not in of and setting.partition(".")[0] not in of:
            continue
        action = "append" if setting in LISTS else "store"
        group.add_argument(flag, dest=_slot(setting), metavar=placeholder, help=text, action=action)
    if not of:
        group.add_argument("--no-view", action="store_true", help="serve no page")
    if not of or "ros2" in of:
        group.add_argument("--ros2", action="store_true", help="show maps and frames to ROS 2 nodes (rmw_zenoh)")
    group.add_argument("--set", dest="assignments", action="append", default=[], metavar="KEY=VALUE", help="any other setting")


def load_from(args: argparse.Namespace) -> Loaded:
    """The settings in force for these arguments; a mistake ends the command with code 2."""
    flags: list[tuple[str, str, Any]] = []
    for flag, setting, _, _ in FLAGS:
        value = getattr(args, _slot(setting), None)
        if value is not None:
            flags.append((flag, setting, value))
    if getattr(args, "no_view", False):
        flags.append(("--no-view", "view.enabled", False))
    if getattr(args, "ros2", False):
        flags.append(("--ros2", "ros2.enabled", True))
    try:
        flags += [assignment("--set", text) for text in getattr(args, "assignments", [])]
        return load_config(args.config, flags)
    except ConfigError as error:
        raise CommandError(str(error), USAGE) from error


def _slot(setting: str) -> str:
    return "setting_" + setting.replace(".", "_")
