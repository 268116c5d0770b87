"""The hardest day of a fleet's network: hundreds of faults on robots behind cables, and after each the question: one map again?

    .venv/bin/python -m tests.campaigns.network_nemesis [--robots 5] [--episodes 200] [--seed 0] [--kinds cut,twin] [--json]

Two routers are joined by a bridge; every robot is a client of one of them, through a cable of its own.

cut, hole, slow, flap    some robots' cables are pulled, swallow everything, carry 64 kbit/s, or come and go
halves, bridge           half of the robots falls silent; the routers lose each other: two whole groups that must become one
restart                  kill -9, and the robot starts again: a new boot, its map from disk
stop                     SIGSTOP, then SIGCONT: a robot that sleeps and knows nothing of it
twin                     a second process uses the name of a robot, in the same place, and goes away again

Bars (RELIABILITY.md, C4): every episode converges to one digest, p99 within 5 s of the heal, no worker fails, and no robot that
was not itself stopped or killed ceases to map.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import random
import signal
import statistics
import sys
import time
from dataclasses import dataclass
from typing import Any

from agent.commands.children import AgentProcess
from agent.commands.demo_stage import Actor, Stage
from agent.runtime.control import ControlError
from tests.harness.fleet import Fleet
from tests.harness.network import Cable, Mode, Network
from tests.harness.processes import percentile, print_row

CONVERGE_WITHIN_S = 60.0
BAR_S = 5.0
KINDS: tuple[str, ...] = ("cut", "hole", "slow", "flap", "halves", "bridge", "restart", "stop", "twin")
LASTING_S = (0.3, 2.5)


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, default=5)
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kinds", default=",".join(KINDS), help="of these")
    parser.add_argument("--particles", type=int, default=10, help="few, since all share this machine's cores")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args(argv)
    figures = Nemesis(args).run()
    print_row(figures, as_json=args.json)
    is_whole = figures["converged"] == figures["episodes"] and figures["p99 s"] <= BAR_S
    return 0 if is_whole and figures["worker errors"] == 0 and figures["mapping stood still"] == 0 else 1


@dataclass
class Place:
    """Where it happens."""

    fleet: Fleet
    stage: Stage
    network: Network
    cables: dict[str, Cable]  # by robot
    bridge: Cable  # between the routers
    twin: Actor  # the devices of whoever uses a name that is not its own


class Nemesis:
    """One campaign."""

    def __init__(self, args: argparse.Namespace) -> None:
        self.place: Place
        self.args, self.rng = args, random.Random(args.seed)
        self.times_s: list[float] = []
        self.failed: list[str] = []
        self.errors = self.stood_still = 0
        self.by_kind: dict[str, list[float]] = {}

    def run(self) -> dict[str, Any]:
        args = self.args
        with Fleet() as fleet:
            network, here = fleet.network(), fleet.router("router-1")
            bridge = network.cable(here)
            there = fleet.router("router-2", connect=[bridge.locator])
            stage, twins = fleet.stage("office", robots=args.robots), fleet.stage("office", robots=1, prefix="twin")
            routers = itertools.cycle((here, there))
            cables = {actor.name: network.cable(next(routers)) for actor in stage.robots}
            self.place = Place(fleet, stage, network, cables, bridge, twins.robots[0])
            for name in cables:
                self.start(name)
            fleet.begin(stage)
            names = list(cables)
            fleet.until(lambda: fleet.agree(*names), 180.0, "one map before the first fault")
            for number in range(args.episodes):
                kind = self.rng.choice(args.kinds.split(","))
                scans = self.scans()
                excused = self.episode(kind)
                self.heal(number, kind)
                now = self.scans()
                self.stood_still += sum(now[name] <= scans[name] for name in names if name not in excused)
            self.errors += sum(w["errors"] for name in names for w in fleet.status(name).get("workers", []))
        ordered = sorted(self.times_s) or [float("nan")]
        return {
            "episodes": args.episodes,
            "converged": len(self.times_s),
            "failed": ", ".join(self.failed) or "none",
            "median s after heal": statistics.median(ordered),
            "p99 s": percentile(ordered, 0.99),
            "worst s": ordered[-1],
            "worst of a kind": ", ".join(f"{kind} {max(times):.1f}" for kind, times in sorted(self.by_kind.items())),
            "mapping stood still": self.stood_still,
            "worker errors": self.errors,
        }

    def scans(self) -> dict[str, int]:
        fleet = self.place.fleet
        return {name: fleet.status(name).get("mapping", {}).get("scans", 0) for name in self.place.cables}

    def start(self, name: str) -> None:
        place = self.place
        actor = next(actor for actor in place.stage.robots if actor.name == name)
        place.fleet.start(actor, connect=[place.cables[name].locator], arguments=self.settings())

    def settings(self) -> list[str]:
        return ["--profile", "infrastructure", "--set", f"mapping.particles={self.args.particles}"]

    def episode(self, kind: str) -> set[str]:
        """One fault, from its begin to its heal; the robots that were made to stop mapping."""
        names = list(self.place.cables)
        victims = self.rng.sample(names, self.rng.randint(1, max(1, len(names) // 2)))
        lasting_s = self.rng.uniform(*LASTING_S)
        if kind == "restart":
            self.restart(victims[0])
            return {victims[0]}
        if kind == "stop":
            self.stop(victims, lasting_s)
            return set(victims)
        if kind == "twin":
            self.twin(victims[0], lasting_s)
        elif kind == "bridge":
            self.place.network.set(self.place.bridge, self.rng.choice(("cut", "hole")))
            time.sleep(lasting_s)
            self.place.network.set(self.place.bridge, "pass")
        elif kind == "flap":
            for _ in range(4):
                self.set_all(victims, "cut")
                time.sleep(lasting_s / 8)
                self.set_all(victims, "pass")
                time.sleep(lasting_s / 8)
        elif kind == "halves":
            self.set_all(names[: len(names) // 2], "hole")
            time.sleep(lasting_s)
        else:
            modes: dict[str, Mode] = {"cut": "cut", "hole": "hole", "slow": "slow"}
            self.set_all(victims, modes[kind])
            time.sleep(lasting_s)
        self.set_all(names, "pass")
        return set()

    def restart(self, victim: str) -> None:
        fleet = self.place.fleet
        self.errors += sum(w["errors"] for w in fleet.status(victim).get("workers", []))
        with contextlib.suppress(ControlError):
            fleet.agents[victim].ask("save")
        fleet.agents[victim].kill()
        self.start(victim)

    def stop(self, victims: list[str], lasting_s: float) -> None:
        for name in victims:
            self.place.fleet.agents[name].signal(signal.SIGSTOP)
        time.sleep(lasting_s)
        for name in victims:
            self.place.fleet.agents[name].signal(signal.SIGCONT)

    def twin(self, victim: str, lasting_s: float) -> None:
        """Another process by the name of `victim`, with devices, memory and a cable of its own, until the fault is over."""
        place = self.place
        folder = place.fleet.folder / "twin"
        folder.mkdir(exist_ok=True)
        dial = ["--fleet", place.fleet.name, "--no-view", "--no-state", "--connect", place.cables[victim].target]
        twin = AgentProcess(victim, [*place.twin.arguments(), *dial, *self.settings()], folder)
        try:
            twin.wait_ready()
            time.sleep(lasting_s)
        finally:
            twin.kill()

    def set_all(self, names: list[str], mode: Mode) -> None:
        for name in names:
            self.place.network.set(self.place.cables[name], mode)

    def heal(self, number: int, kind: str) -> None:
        """How long until every robot hears every other and all hold one map."""
        fleet, names = self.place.fleet, list(self.place.cables)

        def is_whole() -> bool:
            statuses = [fleet.status(name) for name in names]
            heard = all(sum(p["state"] == "alive" for p in s.get("peers", [])) == len(names) - 1 for s in statuses)
            digests = {(s.get("global") or {}).get("digest") for s in statuses}
            return heard and len(digests) == 1 and all((s.get("global") or {}).get("members") == sorted(names) for s in statuses)

        try:
            seconds = fleet.until(is_whole, CONVERGE_WITHIN_S, f"episode {number} ({kind})")
        except AssertionError as error:
            self.failed.append(f"{number}:{kind}")
            print(str(error).splitlines()[0], file=sys.stderr)
            for name in names:
                print(f"  {name}: {who_is_missing(fleet.status(name), names)}", file=sys.stderr)
            return
        self.times_s.append(seconds)
        self.by_kind.setdefault(kind, []).append(seconds)
        print(f"episode {number:3d} {kind:8s} whole after {seconds:4.1f} s", file=sys.stderr)


def who_is_missing(status: dict[str, Any], names: list[str]) -> str:
    """Why a robot does not hold the map of all."""
    held = status.get("global") or {}
    silent = [peer["robot"] for peer in status.get("peers", []) if peer["state"] != "alive"]
    pairs = {peer["robot"]: peer["reason"] for peer in status.get("peers", []) if peer["robot"] not in held.get("members", [])}
    return (
        f"map {str(held.get('digest'))[:8]} without {sorted(set(names) - set(held.get('members', [])))}, silent {silent}, {pairs}"
    )


if __name__ == "__main__":
    sys.exit(main())
