"""`mapquilt config show|check`: the settings in force, and where each came from."""

from __future__ import annotations

import argparse
import json

from agent.config import Config, Value
from agent.config_flags import add_config_arguments, load_from
from agent.config_sources import Loaded
from agent.exits import OK, USAGE, CommandError

EXAMPLES = """\
  mapquilt config show                       every setting, as a file that can be used with --config
  mapquilt config show --origin              ... and where each value came from
  mapquilt config check --config robot.toml  says what is wrong with a file, or nothing
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("action", choices=("show", "check"), nargs="?", default="show")
    parser.add_argument("--origin", action="store_true", help="where each value came from")
    parser.add_argument("--json", action="store_true", help="one JSON object")
    add_config_arguments(parser)


def run(args: argparse.Namespace) -> int:
    loaded = load_from(args)
    if args.action == "check":
        check(loaded.config)
        return OK
    print(as_json(loaded) if args.json else as_toml(loaded, args.origin))
    return OK


def check(config: Config) -> None:
    """What a start would refuse: device URLs and the network's settings; nothing is opened."""
    from agent.runtime.network import NetworkConfigError  # noqa: PLC0415  `config show` need not load NumPy
    from agent.runtime.settings import network_settings, wheels_url  # noqa: PLC0415
    from hw.device import open_lidar, open_wheels  # noqa: PLC0415
    from hw.errors import DeviceConfigError  # noqa: PLC0415

    try:
        if config.lidar.url:
            open_lidar(config.lidar.url)
        if config.wheels.url:
            open_wheels(wheels_url(config))
        network_settings(config)
    except (DeviceConfigError, NetworkConfigError) as error:
        raise CommandError(str(error), USAGE) from error


def as_json(loaded: Loaded) -> str:
    return json.dumps({name: {"value": value, "origin": loaded.origins[name]} for name, value in loaded.config.items()}, indent=2)


def as_toml(loaded: Loaded, with_origin: bool) -> str:
    """A settings file; origins stand in comments, so that it stays one."""
    lines: list[str] = []
    section = ""
    for name, value in loaded.config.items():
        before, _, key = name.partition(".")
        if before != section:
            section = before
            lines += ["", f"[{section}]"] if lines else [f"[{section}]"]
        text = f"{key} = {toml_value(value)}"
        lines.append(f"{text:<44} # {loaded.origins[name]}" if with_origin else text)
    return "\n".join(lines)


def toml_value(value: Value) -> str:
    if isinstance(value, tuple):
        return "[" + ", ".join(json.dumps(part, ensure_ascii=False) for part in value) + "]"
    return json.dumps(value, ensure_ascii=False)  # TOML's basic strings, numbers and booleans are JSON's
