"""`mapquilt run`: be a robot, until told to stop."""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import faulthandler
import json
import logging
import os
import signal
import sys
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2

from agent.commands.plugged_in import with_what_is_plugged_in
from agent.config import Config, control_socket, state_dir
from agent.config_flags import add_config_arguments, load_from
from agent.exits import BAD_INPUT, ENVIRONMENT, OK, PEER, USAGE, CommandError
from agent.map_files import MapFileError
from agent.runtime.control import ControlError
from agent.runtime.exchange import ExchangeError
from agent.runtime.log_setup import set_up_logging
from agent.runtime.memory import keep_memory_small
from agent.runtime.network import NetworkConfigError
from agent.runtime.node import Node
from agent.runtime.ros_bridge import MapSource, RosBridge
from agent.runtime.state import StateTaken, held
from hw.errors import DeviceConfigError

if TYPE_CHECKING:
    from agent.view.server import ViewServer, ViewSource

log = logging.getLogger(__name__)

EXAMPLES = """\
  mapquilt run --lidar rplidar:/dev/ttyUSB0 --wheels wheels:/dev/ttyACM0
  mapquilt run --config robot.toml --id robot-1 --profile lan --security shared
  mapquilt run --id r1 --lidar sim:office?seed=3 --no-view
  mapquilt run --ros2                                      maps and frames as ROS 2 topics (rmw_zenoh, no ROS needed here)
"""

EXIT_WATCHDOG_S = 12.0  # Zenoh may take 10 s to close a dead link; after that the process goes anyway
PORTS_TRIED = 20
PR_SET_PDEATHSIG = 1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_config_arguments(parser)
    parser.add_argument("--ready-json", action="store_true", help="print one JSON line with addresses once the robot is up")
    parser.add_argument("--no-state", action="store_true", help="keep nothing on disk")
    parser.add_argument(
        "--die-with-parent", type=int, metavar="PID", help="stop when the process PID, which started this one, ends"
    )


def run(args: argparse.Namespace) -> int:
    config = load_from(args).config
    if args.quiet or args.verbose:
        config = replace(config, log=replace(config.log, level="warning" if args.quiet else "debug"))
    set_up_logging(config.log.level, config.robot.id)
    if args.die_with_parent:
        die_with_parent(args.die_with_parent)
    cv2.setNumThreads(1)  # one core is for mapping; OpenCV's own threads only get in its way
    keep_memory_small()
    stopping = StopSignals()
    folder = None if args.no_state else state_dir(config, os.environ)
    with contextlib.ExitStack() as stack:
        hold(folder, stack)
        node = make_node(with_devices(config), folder)
        stopping.then(node.stopping.set)
        stack.enter_context(exit_watchdog(node.stopping))
        stack.enter_context(running(node))
        page = serve_page(node.keeper, config) if config.view.enabled else None
        if page is not None:
            stack.callback(page.close)
        join_ros2(node.keeper, config, stack)
        if args.ready_json:
            print(json.dumps(ready_line(node, page)), flush=True)
        log.info("up fleet=%s profile=%s security=%s", config.fleet.name, config.fleet.profile, config.fleet.security)
        node.run()
        log.info("stopping")
    return OK


def with_devices(config: Config) -> Config:
    """A simulator or a recording is both devices at once; without a LIDAR in the settings, whatever is plugged in is taken."""
    if not config.lidar.url:
        return with_what_is_plugged_in(config)
    if not config.wheels.url and config.lidar.url.startswith(("sim:", "log:")):
        return replace(config, wheels=replace(config.wheels, url=config.lidar.url))
    return config


def hold(folder: Path | None, stack: contextlib.ExitStack) -> None:
    try:
        stack.enter_context(held(folder))
    except StateTaken as error:
        raise CommandError(str(error), ENVIRONMENT) from error


def make_node(config: Config, folder: Path | None) -> Node:
    try:
        return Node(config, folder, control_socket(config.robot.id, os.environ))
    except (DeviceConfigError, NetworkConfigError) as error:
        raise CommandError(str(error), USAGE) from error
    except MapFileError as error:
        raise CommandError(str(error), BAD_INPUT) from error


@contextlib.contextmanager
def running(node: Node) -> Any:
    """The node, up; what keeps it from coming up is one sentence and an exit code."""
    try:
        node.__enter__()
    except ExchangeError as error:
        raise CommandError(str(error), PEER) from error
    except ControlError as error:
        raise CommandError(str(error), ENVIRONMENT) from error
    except NetworkConfigError as error:
        raise CommandError(str(error), USAGE) from error
    except DeviceConfigError as error:
        raise CommandError(str(error), BAD_INPUT) from error
    try:
        yield
    finally:
        node.stop()


def serve_page(source: ViewSource, config: Config) -> ViewServer | None:
    """The page on the wished port, or on the next free one; a robot without a page is still a robot."""
    from agent.view.server import ViewServer  # noqa: PLC0415  a robot without a page need not carry 3 MB of HTTP

    wished = config.view.port
    for port in range(wished, wished + PORTS_TRIED) if wished else (0,):
        try:
            page = ViewServer(source, port, config.view.host)
        except (OSError, OverflowError):
            continue
        page.start()
        log.info("page %s", page.url)
        return page
    log.warning("no page: ports %d to %d of %s are taken", wished, wished + PORTS_TRIED - 1, config.view.host)
    return None


def join_ros2(source: MapSource, config: Config, stack: contextlib.ExitStack) -> None:
    """Speak to ROS 2 nodes when asked to; a robot that cannot is still a robot."""
    if config.ros2.enabled:
        try:
            stack.enter_context(RosBridge(source, config.robot.id, config.ros2))
        except ExchangeError as error:
            log.warning("no ROS 2: %s", error)


def ready_line(node: Node, page: ViewServer | None) -> dict[str, Any]:
    node.keeper.locators = node.fleet.exchange.locators()
    return {
        "ready": True,
        "robot": node.robot,
        "pid": os.getpid(),
        "locators": node.keeper.locators,
        "page": page.url if page else None,
        "control": str(node.control.path) if node.control else None,
    }


class StopSignals:
    """SIGTERM and Ctrl-C ask for a clean stop; the second one goes at once."""

    def __init__(self) -> None:
        self._action: Callable[[], None] | None = None  # nothing is open yet that must be closed
        self._count = 0
        signal.signal(signal.SIGTERM, self._on_signal)
        signal.signal(signal.SIGINT, self._on_signal)
        faulthandler.enable()  # systemd's watchdog sends SIGABRT: leave a trace of every thread

    def then(self, action: Callable[[], None]) -> None:
        self._action = action

    def _on_signal(self, number: int, _: object) -> None:
        self._count += 1
        if self._action is None or self._count > 1:
            os._exit(128 + number)
        self._action()


@contextlib.contextmanager
def exit_watchdog(stopping: threading.Event) -> Any:
    """Once stopping began the process ends, even when a library hangs."""
    done = threading.Event()

    def watch() -> None:
        stopping.wait()
        if not done.wait(EXIT_WATCHDOG_S):
            sys.stderr.write("mapquilt: stopping took too long, leaving anyway\n")
            os._exit(OK)

    threading.Thread(target=watch, name="exit-watchdog", daemon=True).start()
    try:
        yield
    finally:
        stopping.set()
        done.set()


def die_with_parent(parent: int) -> None:
    """The kernel ends this process when its parent ends, however that happens."""
    ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != parent:
        raise CommandError("the process that started this robot is gone", ENVIRONMENT)
