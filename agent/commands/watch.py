"""`mapquilt watch`: the live page of a fleet on a laptop, which listens, checks and draws, and never speaks of a map of its own.

The watcher is a peer without a map: it hears what robots announce, pulls the fleet's map, and shows it on a page.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import secrets
import sys
from dataclasses import replace

from agent.commands.network import on_the_network
from agent.commands.run import join_ros2, serve_page
from agent.config_flags import NETWORK, add_config_arguments, load_from
from agent.exits import OK, USAGE, CommandError
from agent.runtime.log_setup import set_up_logging
from agent.runtime.settings import network_settings
from agent.runtime.watcher import Watcher

EXAMPLES = """\
  mapquilt watch --connect tcp/192.168.1.20:7447          any robot, or the router
  mapquilt watch --profile lan --set fleet.allow_open=true
  mapquilt watch --connect tcp/192.168.1.20:7447 --ros2   the fleet's maps and frames for ROS 2 (rmw_zenoh)
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_config_arguments(parser, "robot.id", *NETWORK, "view", "ros2")
    parser.add_argument("--ready-json", action="store_true", help="print one JSON line with addresses once the page is up")


def run(args: argparse.Namespace) -> int:
    config = load_from(args).config
    name = f"watch-{secrets.token_hex(4)}"  # two laptops may look at once
    if config.fleet.security == "mtls":
        name = config.robot.id  # a certificate names its holder: enroll the laptop as a member
    config = replace(config, robot=replace(config.robot, id=name))
    set_up_logging("warning" if not args.verbose else "info", name)
    with on_the_network() as stopping, Watcher(network_settings(config)) as watcher, contextlib.ExitStack() as stack:
        page = serve_page(watcher, config)
        if page is None:
            raise CommandError(f"no free port from {config.view.port} on; give another with --view-port", USAGE)
        stack.callback(page.close)
        join_ros2(watcher, config, stack)
        if args.ready_json:
            print(json.dumps({"ready": True, "robot": name, "pid": os.getpid(), "page": page.url}), flush=True)
        else:
            print(f"the fleet is at {page.url} until Ctrl-C", file=sys.stderr)
        stopping.wait()
    return OK
