"""`mapquilt pause|resume|reset|save|unmerge|readmit|stop`: one word to the running robot, one sentence back."""

from __future__ import annotations

import argparse

from agent.exits import OK
from agent.running import ask_robot, robot_socket

EXAMPLES = """\
  mapquilt pause                      the only robot that runs here
  mapquilt pause --robot robot-2      this one of several
  mapquilt unmerge robot-3            robot-3's map is taken out of ours, until: mapquilt readmit robot-3
"""

WITH_PEER = ("unmerge", "readmit")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    if parser.get_default("command") in WITH_PEER:
        parser.add_argument("peer", metavar="PEER", help="the other robot")
    parser.add_argument("--robot", metavar="ID", help="which robot, when several run here")


def run(args: argparse.Namespace) -> int:
    _, socket = robot_socket(args.robot)
    more = {"peer": args.peer} if args.command in WITH_PEER else {}
    answer = ask_robot(socket, args.command, **more)
    if not args.quiet:
        print(answer.get("message", "done"))
    return OK
