"""Robots as child processes: started, waited for, asked, and gone in the end whatever happens.

Every child leads a process group of its own and is told to die with us by the kernel, so that neither an exception nor a
`kill -9` of this process leaves a robot behind.  Start children from the main thread only: the kernel counts the
*thread* that started a child as its parent.
"""

from __future__ import annotations

import contextlib
import json
import os
import selectors
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from agent.runtime.control import ControlError, ask
from agent.runtime.packed_maps import unpacked_map
from protocol.grid import OccupancyGrid

READY_WITHIN_S = 30.0
STOP_WITHIN_S = 4.0
CROWD_A_CORE = 2  # robots; with more of them a core is always wanted by somebody
CROWD_NICENESS = 10


def child_environment(folder: Path) -> dict[str, str]:
    """Everything a child keeps is below `folder`, and the settings of this machine's own robot are not a child's.

    One thread of numerics each, since there are many children.  Where this process may keep no bytecode, children keep theirs
    below `folder` too: compiling everything anew is a third of a robot's start.
    """
    places = dict.fromkeys(("XDG_RUNTIME_DIR", "XDG_STATE_HOME"), str(folder))
    bytecode = {"PYTHONDONTWRITEBYTECODE": "", "PYTHONPYCACHEPREFIX": str(folder / "bytecode")} if sys.dont_write_bytecode else {}
    return {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MAPQUILT_CONFIG": os.devnull, **places, **bytecode}


def niceness(robots: int) -> int:
    """Of each of so many robots here: simulated devices keep their pace, as hardware does, even if all robots want the cores."""
    return CROWD_NICENESS if robots > CROWD_A_CORE * (os.cpu_count() or 1) else 0


class ChildError(Exception):
    """A robot did not come up or went away; with the end of its log."""


class AgentProcess:
    """One `mapquilt run` (or another command that speaks the same) as a child."""

    def __init__(
        self,
        robot: str,
        arguments: Sequence[str],
        folder: Path,
        environment: Mapping[str, str] | None = None,
        command: str = "run",
        niceness: int = 0,
    ) -> None:
        self.robot = robot
        self.log_path = folder / f"{robot}.log"
        self._log = self.log_path.open("ab")
        words = [sys.executable, "-m", "agent", command, "--id", robot, *arguments]
        self.process = subprocess.Popen(
            [*words, "--ready-json", "--die-with-parent", str(os.getpid())],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=self._log,
            env={**os.environ, **child_environment(folder), **(environment or {})},
            start_new_session=True,
        )
        if niceness:
            os.setpriority(os.PRIO_PROCESS, self.process.pid, os.getpriority(os.PRIO_PROCESS, 0) + niceness)
        self.ready: dict[str, Any] = {}

    def wait_ready(self, within_s: float = READY_WITHIN_S) -> dict[str, Any]:
        """The robot's ready line: its locators, page and control socket."""
        assert self.process.stdout is not None
        deadline_s, line = time.monotonic() + within_s, b""
        with selectors.DefaultSelector() as selector:
            selector.register(self.process.stdout, selectors.EVENT_READ)
            while not line.endswith(b"\n"):
                if not selector.select(max(0.0, deadline_s - time.monotonic())):
                    raise ChildError(f"{self.robot} is not up after {within_s:.0f} s:\n{self.log_tail()}")
                part = os.read(self.process.stdout.fileno(), 65536)
                if not part:
                    raise ChildError(f"{self.robot} ended with code {self.process.wait()}:\n{self.log_tail()}")
                line += part
        self.ready = json.loads(line)
        return self.ready

    def status(self) -> dict[str, Any]:
        return dict(self.ask("status")["status"])

    def grid(self, name: str = "global") -> OccupancyGrid | None:
        """A map the robot holds; None when it holds none by that name."""
        try:
            return unpacked_map(self.ask("map", name=name)["map"])
        except ControlError:
            return None

    def ask(self, command: str, **arguments: object) -> dict[str, Any]:
        return ask(Path(self.ready["control"]), command, **arguments)

    @property
    def is_running(self) -> bool:
        return self.process.poll() is None

    def signal(self, number: int) -> None:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self.process.pid, number)

    def stop(self, within_s: float = STOP_WITHIN_S) -> int:
        """Ask for a clean stop, insist after a while; the exit code."""
        if self.is_running:
            self.signal(signal.SIGCONT)
            self.signal(signal.SIGTERM)
        try:
            code = self.process.wait(within_s)
        except subprocess.TimeoutExpired:
            code = self.kill()
        self._close()
        return code

    def kill(self) -> int:
        self.signal(signal.SIGKILL)
        code = self.process.wait()
        self._close()
        return code

    def _close(self) -> None:
        self._log.close()
        if self.process.stdout is not None:
            self.process.stdout.close()

    def log_tail(self, lines: int = 15) -> str:
        return "\n".join(self.log_path.read_text(errors="replace").splitlines()[-lines:])


def stop_all(agents: Sequence[AgentProcess]) -> list[int]:
    """All at once: as long as the slowest, not as long as all together."""
    for agent in agents:
        if agent.is_running:
            agent.signal(signal.SIGCONT)
            agent.signal(signal.SIGTERM)
    return [agent.stop() for agent in agents]
