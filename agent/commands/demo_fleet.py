"""The robots of one demo: a real process each, on the devices of a stage."""

from __future__ import annotations

import contextlib
import os
import time
from pathlib import Path
from typing import Any

from agent.commands.children import AgentProcess, ChildError, niceness, stop_all
from agent.commands.demo_stage import Stage
from agent.runtime.control import ControlError

FIRST_SCANS_WITHIN_S = 5.0


class Fleet:
    """All of them; `stack` stops them in the end."""

    def __init__(self, stack: contextlib.ExitStack, stage: Stage, folder: Path) -> None:
        self.stage, self.folder = stage, folder
        self.agents: list[AgentProcess] = []
        self.started_s = time.monotonic()
        self.page = ""
        stack.callback(lambda: stop_all(self.agents))

    def start(self) -> None:
        """The first robot alone, for the others to dial; those all at once."""
        name = f"demo-{os.getpid()}"
        seeds: list[str] = []
        for i, robot in enumerate(self.stage.robots):
            page = ["--view-port", "8080"] if i == 0 else ["--no-view"]
            common = ["--fleet", name, "--no-state", "--set", f"mapping.seed={i}", *page]
            words = [*robot.arguments(), *common, *seeds]
            self.agents.append(AgentProcess(robot.name, words, self.folder, niceness=niceness(len(self.stage.robots))))
            if i == 0:
                ready = self.agents[0].wait_ready()
                seeds = ["--connect", ready["locators"][0]]
                self.page = ready["page"] or ""
        for agent in self.agents[1:]:
            agent.wait_ready()
        self.await_first_scans()
        self.stage.begin()
        self.started_s = time.monotonic()

    def await_first_scans(self) -> None:
        """A map begins where its robot stands at the first scan; a robot whose LIDAR does not come up is left behind."""
        deadline_s = time.monotonic() + FIRST_SCANS_WITHIN_S
        while time.monotonic() < deadline_s and self.stage.truth() is not None:
            if all(status["mapping"]["scans"] for status in self.statuses()):
                return
            time.sleep(0.1)

    def statuses(self) -> list[dict[str, Any]]:
        """What every robot says of itself; a robot that went away ends the demo."""
        said = []
        for agent in self.agents:
            if not agent.is_running:
                raise ChildError(f"{agent.robot} went away with code {agent.process.returncode}:\n{agent.log_tail()}")
            with contextlib.suppress(ControlError):
                said.append(agent.status())
        return said
