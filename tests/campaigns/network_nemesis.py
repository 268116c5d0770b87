"""The hardest day of a fleet's network: hundreds of faults on robots behind cables, and after each the question: one map again?

    .venv/bin/python -m tests.campaigns.network_nemesis [--robots 5] [--episodes 200] [--seed 0] [--json]

Every robot is a client of one router through a cable of its own.  An episode cuts, swallows or slows the cables of some robots,
or kills one and starts it again, for a random time, then heals; the fleet must hold one map with one digest again.

Bars (RELIABILITY.md, C4): every episode converges, p99 within 5 s of the heal, no worker fails, mapping never stops.
"""

from __future__ import annotations

import argparse
import json
import random
import statistics
import sys
import time
from typing import Any

from agent.commands.demo_stage import Stage
from tests.harness.fleet import Fleet
from tests.harness.network import Cable, Mode, Network

CONVERGE_WITHIN_S = 60.0
KINDS: tuple[str, ...] = ("cut", "hole", "slow", "flap", "halves", "restart")


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, default=5)
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--particles", type=int, default=10, help="few, since all share this machine's cores")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args(argv)
    figures = Nemesis(args).run()
    if args.json:
        print(json.dumps(figures))
    else:
        print("| " + " | ".join(figures) + " |\n|" + " --- |" * len(figures))
        print("| " + " | ".join(f"{v:.2f}" if isinstance(v, float) else str(v) for v in figures.values()) + " |")
    return 0 if figures["converged"] == figures["episodes"] and figures["worker errors"] == 0 else 1


class Nemesis:
    """One campaign."""

    def __init__(self, args: argparse.Namespace) -> None:
        self.args, self.rng = args, random.Random(args.seed)
        self.times_s: list[float] = []
        self.failed: list[str] = []
        self.errors = 0

    def run(self) -> dict[str, Any]:
        args = self.args
        with Fleet() as fleet:
            network, router = fleet.network(), fleet.router()
            stage = fleet.stage("office", robots=args.robots)
            cables = {actor.name: network.cable(router) for actor in stage.robots}
            for actor in stage.robots:
                self.start(fleet, stage, cables, actor.name)
            fleet.begin(stage)
            names = list(cables)
            fleet.until(lambda: fleet.agree(*names), 180.0, "one map before the first fault")
            for number in range(args.episodes):
                kind = self.rng.choice(KINDS)
                self.episode(fleet, stage, network, cables, kind)
                self.heal(fleet, names, number, kind)
            self.errors += sum(w["errors"] for name in names for w in fleet.status(name).get("workers", []))
        ordered = sorted(self.times_s) or [float("nan")]
        return {
            "episodes": args.episodes,
            "converged": len(self.times_s),
            "failed": ", ".join(self.failed) or "none",
            "median s after heal": statistics.median(ordered),
            "p99 s": ordered[min(len(ordered) - 1, round(0.99 * (len(ordered) - 1)))],
            "worst s": ordered[-1],
            "worker errors": self.errors,
        }

    def start(self, fleet: Fleet, stage: Stage, cables: dict[str, Cable], name: str) -> None:
        actor = next(actor for actor in stage.robots if actor.name == name)
        few = ["--profile", "infrastructure", "--set", f"mapping.particles={self.args.particles}"]
        fleet.start(actor, connect=[cables[name].locator], arguments=few)

    def episode(self, fleet: Fleet, stage: Stage, network: Network, cables: dict[str, Cable], kind: str) -> None:
        names = list(cables)
        victims = self.rng.sample(names, self.rng.randint(1, max(1, len(names) // 2)))
        lasting_s = self.rng.uniform(0.5, 4.0)
        if kind == "restart":
            victim = victims[0]
            self.errors += sum(w["errors"] for w in fleet.status(victim).get("workers", []))
            fleet.agents[victim].kill()
            self.start(fleet, stage, cables, victim)
        elif kind == "flap":
            for _ in range(4):
                self.set_all(network, cables, victims, "cut")
                time.sleep(lasting_s / 8)
                self.set_all(network, cables, victims, "pass")
                time.sleep(lasting_s / 8)
        elif kind == "halves":
            self.set_all(network, cables, names[: len(names) // 2], "hole")
            time.sleep(lasting_s)
        else:
            modes: dict[str, Mode] = {"cut": "cut", "hole": "hole", "slow": "slow"}
            self.set_all(network, cables, victims, modes[kind])
            time.sleep(lasting_s)
        self.set_all(network, cables, names, "pass")

    def set_all(self, network: Network, cables: dict[str, Cable], names: list[str], mode: Mode) -> None:
        for name in names:
            network.set(cables[name], mode)

    def heal(self, fleet: Fleet, names: list[str], number: int, kind: str) -> None:
        """How long until every robot hears every other and all hold one map."""

        def is_whole() -> bool:
            statuses = [fleet.status(name) for name in names]
            heard = all(sum(p["state"] == "alive" for p in s.get("peers", [])) == len(names) - 1 for s in statuses)
            digests = {(s.get("global") or {}).get("digest") for s in statuses}
            return heard and len(digests) == 1 and all((s.get("global") or {}).get("members") == sorted(names) for s in statuses)

        try:
            seconds = fleet.until(is_whole, CONVERGE_WITHIN_S, f"episode {number} ({kind})")
        except AssertionError as error:
            self.failed.append(f"{number}:{kind}")
            print(str(error)[:3000], file=sys.stderr)
            return
        self.times_s.append(seconds)
        print(f"episode {number:3d} {kind:8s} whole after {seconds:4.1f} s", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
