"""`mapquilt router`: a meeting point for larger fleets, at a base station.  It carries words and keeps none."""

from __future__ import annotations

import argparse
import contextlib
import json
import os

from agent.commands.network import on_the_network
from agent.commands.run import die_with_parent
from agent.config_flags import NETWORK, add_config_arguments, load_from
from agent.exits import OK
from agent.runtime.exchange import Exchange
from agent.runtime.health import Notifier
from agent.runtime.log_setup import set_up_logging
from agent.runtime.settings import network_settings

EXAMPLES = """\
  mapquilt router --listen tcp/0.0.0.0:7447 --security mtls
      robots then: --profile infrastructure --connect tcp/BASE:7447
  mapquilt router --connect tcp/OTHER-BASE:7447        a second one, linked to the first
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_config_arguments(parser, "robot.id", *NETWORK)
    parser.add_argument("--ready-json", action="store_true", help="print one JSON line with addresses once the router is up")
    parser.add_argument("--die-with-parent", type=int, metavar="PID", help=argparse.SUPPRESS)


def run(args: argparse.Namespace) -> int:
    config = load_from(args).config
    set_up_logging(config.log.level, config.robot.id)
    if args.die_with_parent:
        die_with_parent(args.die_with_parent)
    with on_the_network() as stopping, Exchange(network_settings(config, is_router=True), lambda _: None) as exchange:
        locators = exchange.locators()
        if args.ready_json:
            print(json.dumps({"ready": True, "pid": os.getpid(), "locators": locators}), flush=True)
        elif not args.quiet:
            print(f"router at {', '.join(locators)}", flush=True)
        Notifier().send("READY=1")
        with contextlib.suppress(KeyboardInterrupt):
            stopping.wait()
    return OK
