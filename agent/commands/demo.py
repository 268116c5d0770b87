"""`mapquilt demo`: a fleet of real robot processes on simulated devices behind real ptys, talking over real Zenoh.

Nobody tells the robots where they started.  They explore, exchange compact maps, find out how those fit, and end up with
one map; this command only watches, and in the end holds that map against the simulated world.
"""

from __future__ import annotations

import argparse
import contextlib
import signal
import sys
import tempfile
import threading
from pathlib import Path

from agent.arguments import number, whole
from agent.commands.children import ChildError
from agent.commands.demo_fleet import Fleet
from agent.commands.demo_show import Show
from agent.commands.demo_stage import Stage, open_stage
from agent.exits import ENVIRONMENT, INTERRUPTED, NEGATIVE, OK, USAGE, CommandError
from hw.errors import DeviceConfigError

EXAMPLES = """\
  mapquilt demo                               three robots in a simulated office
  mapquilt demo --robots 5 --world random --seed 7
  mapquilt demo --world log:intel.clf.gz      a recording cut in two, as two robots
  mapquilt demo --no-serve --json             for scripts: figures as one JSON object
"""

DURATION_S = 25.0  # exploring goes on this long although the maps may fit sooner: a person sees the map grow


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--robots", type=int, default=0, metavar="N", help="how many (default: 3; a recording is cut for 2)")
    parser.add_argument("--world", default="office", help="office, outdoor, random, a world file, or log:FILE.clf[.gz]")
    parser.add_argument("--seed", type=whole(0), default=0, help="another building, other starts, other noise")
    parser.add_argument(
        "--duration", type=number(0), metavar="S", help="seconds of exploring (default: 25, or the whole recording)"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("out/demo"), metavar="DIR", help="where pictures and figures go (default: out/demo)"
    )
    parser.add_argument("--no-serve", action="store_true", help="end when done, instead of showing the page until Ctrl-C")
    parser.add_argument("--json", action="store_true", help="the figures as one JSON object on stdout")


def run(args: argparse.Namespace) -> int:
    args.robots = args.robots or (2 if args.world.startswith("log:") else 3)
    if not 1 <= args.robots <= 20:
        raise CommandError(f"--robots {args.robots}: choose 1 to 20", USAGE)
    interrupted = threading.Event()
    for ending in (signal.SIGTERM, signal.SIGINT):
        signal.signal(ending, lambda *_: interrupted.set())
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="mq-")))  # short: sockets have short names
        fleet = Fleet(stack, set_stage(args, stack, folder), folder)
        try:
            fleet.start()
            show = Show(args, fleet)
            show.watch(interrupted)
            figures = show.finish()
        except ChildError as error:
            raise CommandError(str(error), ENVIRONMENT) from error
        show.say(figures)
        if serves(args) and figures.are_all_merged and not interrupted.is_set():
            print(f"the page stays at {fleet.page} until Ctrl-C", file=sys.stderr)
            interrupted.wait()
    if interrupted.is_set() and not figures.are_all_merged:
        return INTERRUPTED
    return OK if figures.are_all_merged or args.robots == 1 else NEGATIVE


def set_stage(args: argparse.Namespace, stack: contextlib.ExitStack, folder: Path) -> Stage:
    """The world and its robots; how long they explore when nobody said."""
    try:
        stage = stack.enter_context(open_stage(args.world, args.robots, args.seed, folder))
    except DeviceConfigError as error:
        raise CommandError(str(error), USAGE) from error
    if args.duration is None:
        args.duration = stage.duration_s() or DURATION_S
    return stage


def serves(args: argparse.Namespace) -> bool:
    """A person at a terminal wants to look; a script wants the answer."""
    return not args.no_serve and not args.json and sys.stdout.isatty()
