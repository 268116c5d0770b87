"""The robots that run on this machine, found by their control sockets.

Sockets of one's own robots lie in one's runtime directory, those of systemd's services in /run/mapquilt/ID (root's to read).
"""

from __future__ import annotations

import contextlib
import errno
import os
import socket
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from agent.config import runtime_dir
from agent.exits import PEER, USAGE, CommandError
from agent.runtime.control import ControlError, ask

SERVICES = Path("/run/mapquilt")


def running_robots(environ: Mapping[str, str] | None = None) -> dict[str, Path]:
    """Name -> socket, one's own first."""
    return {robot: path for robot, path in _sockets(environ).items() if not _is_left_over(path)}


def robot_socket(robot: str | None, environ: Mapping[str, str] | None = None) -> tuple[str, Path]:
    """The robot that is meant: the named one, or the only one there is."""
    found = running_robots(environ)
    gone = [name for name in _sockets(environ) if name not in found and robot in (None, name)]
    ended = f"; {', '.join(gone)} ended without a word and does not answer" if gone else ""
    if robot is not None:
        if robot not in found:
            there = f"running here: {', '.join(found)}" if found else "none runs here"
            raise CommandError(
                f"no robot '{robot}' runs here under this user ({there}){ended}; a service is root's: try sudo", PEER
            )
        return robot, found[robot]
    if not found:
        raise CommandError(
            f"no robot runs here under this user{ended}; start one with mapquilt run, or try sudo for a service", PEER
        )
    if len(found) > 1:
        raise CommandError(f"several robots run here; say which one with --robot: {', '.join(found)}", USAGE)
    return next(iter(found.items()))


def _sockets(environ: Mapping[str, str] | None) -> dict[str, Path]:
    own = runtime_dir(os.environ if environ is None else environ)
    found: dict[str, Path] = {}
    for pattern, folder in (("*.sock", own), ("*.sock", SERVICES), ("*/*.sock", SERVICES)):
        try:
            paths = sorted(folder.glob(pattern))
        except OSError:
            continue  # another user's
        for path in paths:
            found.setdefault(path.stem, path)
    return found


def _is_left_over(path: Path) -> bool:
    """From a robot that was killed: nobody listens."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe, contextlib.suppress(OSError):
        probe.settimeout(0.5)
        return probe.connect_ex(str(path)) == errno.ECONNREFUSED
    return False


def ask_robot(socket: Path, command: str, **arguments: object) -> dict[str, Any]:
    """The robot's answer; no answer, or a refusal, ends the command with code 5."""
    try:
        return ask(socket, command, **arguments)
    except ControlError as error:
        raise CommandError(str(error), PEER) from error
