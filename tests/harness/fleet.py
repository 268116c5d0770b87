"""Fleets of real robot processes for stories: started on ephemeral ports, looked at, hurt on purpose, gone in the end.

with Fleet(tmp_path) as fleet:
    stage = fleet.stage("office", robots=2)
    fleet.start(stage.robots[0]); fleet.start(stage.robots[1])
    stage.begin()
    fleet.until(lambda: fleet.agree("robot-1", "robot-2"), 40.0)
"""

from __future__ import annotations

import contextlib
import itertools
import os
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from agent.commands.children import AgentProcess, stop_all
from agent.commands.demo_stage import Actor, Stage, open_stage
from agent.runtime.control import ControlError
from tests.harness.network import Network

LOOK_EVERY_S = 0.2
_numbers = itertools.count()


class Fleet:
    """Robots that know one another by the first one's address (or by `connect`).  One fleet name per test."""

    def __init__(self, niceness: int = 0) -> None:
        self._niceness = niceness
        self._stack = contextlib.ExitStack()
        self.name = f"test-{os.getpid()}-{next(_numbers)}"
        self.agents: dict[str, AgentProcess] = {}
        self.folder = Path()

    def __enter__(self) -> Fleet:
        self.folder = Path(self._stack.enter_context(tempfile.TemporaryDirectory(prefix="mq-")))  # sockets need short names
        self._stack.callback(lambda: stop_all(list(self.agents.values())))
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def stage(self, world: str, robots: int, seed: int = 0, prefix: str = "robot") -> Stage:
        """Simulated robots in one world, on ptys."""
        folder = self.folder / f"{prefix}-devices"
        folder.mkdir()
        return self._stack.enter_context(open_stage(world, robots, seed, folder, prefix))

    def start(
        self,
        actor: Actor,
        *,
        connect: Sequence[str] | None = None,
        arguments: Sequence[str] = (),
        environment: Mapping[str, str] | None = None,
    ) -> AgentProcess:
        """A robot's process on an actor's devices, up and ready; by default it dials the first robot that was started."""
        dial = (
            connect
            if connect is not None
            else [a.ready["locators"][0] for a in list(self.agents.values())[:1] if a.robot != actor.name]
        )
        connections = [part for locator in dial for part in ("--connect", locator)]
        common = ["--fleet", self.name, "--no-view", *connections, *arguments]
        agent = AgentProcess(actor.name, [*actor.arguments(), *common], self.folder, environment, niceness=self._niceness)
        previous, self.agents[actor.name] = self.agents.get(actor.name), agent
        assert previous is None or not previous.is_running
        agent.wait_ready()
        return agent

    def begin(self, stage: Stage) -> None:
        """The robots drive off once each has seen its surroundings: where it saw them first is where its map begins."""
        names = [actor.name for actor in stage.robots if actor.name in self.agents]
        self.until(lambda: all(self.status(name).get("mapping", {}).get("scans") for name in names), 30.0, "first scans")
        stage.begin()

    def router(self, name: str = "router", connect: Sequence[str] = ()) -> str:
        """A router's process; its locator."""
        connections = [part for locator in connect for part in ("--connect", locator)]
        arguments = ["--fleet", self.name, "--listen", "tcp/127.0.0.1:0", *connections]
        router = AgentProcess(name, arguments, self.folder, command="router")
        self._stack.callback(router.stop)
        return str(router.wait_ready()["locators"][0])

    def network(self) -> Network:
        """Cables that can be cut."""
        return self._stack.enter_context(Network())

    def status(self, robot: str) -> dict[str, Any]:
        """What a robot says of itself; empty while it cannot answer."""
        try:
            return self.agents[robot].status()
        except ControlError:
            return {}

    def global_digest(self, robot: str) -> str | None:
        return (self.status(robot).get("global") or {}).get("digest")

    def members(self, robot: str) -> list[str]:
        return list((self.status(robot).get("global") or {}).get("members", []))

    def agree(self, *robots: str) -> bool:
        """All hold one and the same global map, made of exactly these robots."""
        states = [self.status(robot).get("global") or {} for robot in robots]
        return len({s.get("digest") for s in states}) == 1 and all(s.get("members") == sorted(robots) for s in states)

    def until(self, condition: Callable[[], object], within_s: float, what: str = "the condition") -> float:
        """Wait for a condition; how long it took.  Late: an error with what every robot says."""
        started = time.monotonic()
        while not condition():
            if time.monotonic() - started > within_s:
                raise AssertionError(f"{what} did not come true within {within_s:.0f} s\n{self.explain()}")
            time.sleep(LOOK_EVERY_S)
        return time.monotonic() - started

    def seconds_to_one_map_at_rest(self, names: Sequence[str], within_s: float = 90.0) -> float | None:
        """Maps stand still; how long until every robot holds the very same global map of all.  None: not in time."""
        for name in names:
            self.agents[name].ask("pause")
        try:
            return self.until(lambda: self.agree(*names), within_s, "one global map at rest")
        except AssertionError as error:
            print(str(error)[:4000], file=sys.stderr)
            return None

    def stays(self, condition: Callable[[], object], for_s: float, what: str = "the condition") -> None:
        """A condition holds all the time."""
        started = time.monotonic()
        while time.monotonic() - started < for_s:
            assert condition(), f"{what} ceased to hold\n{self.explain()}"
            time.sleep(LOOK_EVERY_S)

    def explain(self) -> str:
        lines = []
        for robot, agent in self.agents.items():
            status = self.status(robot)
            facts = (f"{key} {status.get(key)}" for key in ("mapping", "peers", "global", "problems"))
            lines.append(f"{robot}: {', '.join(facts)}")
            lines.append(agent.log_tail(8))
        return "\n".join(lines)
