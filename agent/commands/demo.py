"""`mapquilt demo`: a fleet of real robot processes on simulated devices behind real ptys, talking over real Zenoh.

Nobody tells the robots where they started.  They explore, exchange compact maps, find out how those fit, and end up with
one map; this command only watches, and in the end holds that map against the simulated world.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from agent.commands.children import AgentProcess, ChildError, stop_all
from agent.commands.demo_figures import Figures, agreement, aligned
from agent.commands.demo_stage import Stage, open_stage
from agent.exits import ENVIRONMENT, INTERRUPTED, NEGATIVE, OK, USAGE, CommandError
from agent.runtime.control import ControlError
from agent.view.render import map_picture, png
from hw.errors import DeviceConfigError
from protocol.geometry import SE2
from protocol.grid import OccupancyGrid

EXAMPLES = """\
  mapquilt demo                               three robots in a simulated office
  mapquilt demo --robots 5 --world random --seed 7
  mapquilt demo --world log:intel.clf.gz      a recording cut in two, as two robots
  mapquilt demo --no-serve --json             for scripts: figures as one JSON object
"""

DURATION_S = 25.0  # exploring goes on this long although the maps may fit sooner: a person sees the map grow
LOOK_EVERY_S = 0.5
FIRST_SCANS_WITHIN_S = 5.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--robots", type=int, default=0, metavar="N", help="how many (default: 3; a recording is cut for 2)")
    parser.add_argument("--world", default="office", help="office, outdoor, random, a world file, or log:FILE.clf[.gz]")
    parser.add_argument("--seed", type=int, default=0, help="another building, other starts, other noise")
    parser.add_argument("--duration", type=float, metavar="S", help="seconds of exploring (default: 25, or the whole recording)")
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
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: interrupted.set())
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="mq-")))  # short: sockets have short names
        try:
            stage = stack.enter_context(open_stage(args.world, args.robots, args.seed, folder))
        except DeviceConfigError as error:
            raise CommandError(str(error), USAGE) from error
        if args.duration is None:
            args.duration = stage.duration_s() or DURATION_S
        fleet = Fleet(stack, stage, folder)
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


def serves(args: argparse.Namespace) -> bool:
    """A person at a terminal wants to look; a script wants the answer."""
    return not args.no_serve and not args.json and sys.stdout.isatty()


class Fleet:
    """The robots of one demo."""

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
            self.agents.append(AgentProcess(robot.name, [*robot.arguments(), *common, *seeds], self.folder))
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


class Show:
    """Looks at the fleet, says how it goes, and draws what came of it."""

    def __init__(self, args: argparse.Namespace, fleet: Fleet) -> None:
        self.args, self.fleet = args, fleet
        self.merged_after_s: float | None = None
        self.statuses: list[dict[str, Any]] = []
        if not args.quiet:
            print(f"{len(fleet.agents)} robots are up; the page: {fleet.page}", file=sys.stderr)

    def watch(self, interrupted: threading.Event) -> None:
        """Until every robot is in one map and exploring has gone on for long enough, or time is up."""
        while not interrupted.wait(LOOK_EVERY_S):
            self.statuses = self.fleet.statuses()
            elapsed_s = time.monotonic() - self.fleet.started_s
            are_merged = hold_one_map(self.statuses, len(self.fleet.agents))
            if are_merged and self.merged_after_s is None:
                self.merged_after_s = elapsed_s
            self.progress(elapsed_s)
            if elapsed_s >= self.args.duration and (are_merged or len(self.fleet.agents) == 1):
                return
            if elapsed_s >= max(self.args.duration, self.fleet.stage.time_limit_s()):
                return

    def progress(self, elapsed_s: float) -> None:
        """One line that is overwritten on a terminal, a line every few seconds elsewhere."""
        scans = sum(s["mapping"]["scans"] for s in self.statuses)
        known = sum(s["mapping"].get("known_m2", 0.0) for s in self.statuses)
        links = max((len(s["peers"]) for s in self.statuses), default=0)
        factors = [p["match_factor"] for s in self.statuses for p in s["peers"] if p["match_factor"]]
        groups = max((len(s["group"]) for s in self.statuses), default=0)
        state = f"{groups} of {len(self.statuses)} in one map" if groups else "not merged yet"
        best = f"best match {max(factors):.3f}" if factors else "no match"
        line = f"{elapsed_s:5.1f} s  {scans} scans  {known:.0f} m2  {links} peers  {best}  {state}"
        if self.args.quiet:
            return
        if sys.stderr.isatty():
            print(f"\r\x1b[K{line}", end="", file=sys.stderr, flush=True)
        elif int(elapsed_s / LOOK_EVERY_S) % 10 == 0:
            print(line, file=sys.stderr, flush=True)

    def finish(self) -> Figures:
        """Stop the robots' wheels, look once more, draw the maps."""
        if sys.stderr.isatty() and not self.args.quiet:
            print(file=sys.stderr)
        self.statuses = self.fleet.statuses() or self.statuses
        out: Path = self.args.out
        out.mkdir(parents=True, exist_ok=True)
        for agent, status in zip(self.fleet.agents, self.statuses, strict=False):
            grid = agent.grid(agent.robot)
            if grid is not None:
                pose = status["mapping"].get("pose")
                poses = {agent.robot: SE2(*pose)} if pose else {}
                (out / f"{agent.robot}.png").write_bytes(png(map_picture(grid, poses, f"{agent.robot}: its own map")))
        for agent in self.fleet.agents:
            shutil.copy(agent.log_path, out)
        figures = self.figures(out)
        (out / "figures.json").write_text(json.dumps(asdict(figures), indent=1, default=str) + "\n")
        return figures

    def figures(self, out: Path) -> Figures:
        robots = [agent.robot for agent in self.fleet.agents]
        best = max(self.statuses, key=lambda s: (len(s["group"]), -s["uptime_s"]), default=None)
        fused = self.fused(best["robot"]) if best is not None and best["group"] else None
        if best is None or fused is None:
            (out / "merged.png").unlink(missing_ok=True)
            return Figures(robots, [], None, [], 0.0, 0, None, {}, *self.scans())
        truth, T_world_global = self.fleet.stage.truth(), None
        if truth is not None:
            root = self.fleet.stage.start_pose(best["root"])
            T_world_global = aligned(fused, truth, root) if root is not None else None
        global_poses = self.poses_global()
        title = f"{len(best['group'])} robots, one map of {fused.known_area_m2():.0f} m2"
        (out / "merged.png").write_bytes(png(map_picture(fused, global_poses, title)))
        return Figures(
            robots=robots,
            merged=best["global"]["members"] if best["global"] else best["group"],
            seconds_to_merge=self.merged_after_s,
            match_factors=[edge["match_factor"] for edge in best["edges"]],
            known_m2=fused.known_area_m2(),
            conflicting_cells=best["global"]["conflicting_cells"] if best["global"] else 0,
            agreement=agreement(fused, truth, T_world_global) if truth is not None and T_world_global is not None else None,
            pose_errors_m=self.pose_errors(T_world_global, best["group"]),
            scans=self.scans()[0],
            scans_lost=self.scans()[1],
        )

    def scans(self) -> tuple[int, int]:
        """How many scans came, and how many came too fast."""
        mappings = [s["mapping"] for s in self.statuses]
        return sum(m["scans"] for m in mappings), sum(m["scans_lost"] for m in mappings)

    def fused(self, robot: str) -> OccupancyGrid | None:
        return next(agent for agent in self.fleet.agents if agent.robot == robot).grid()

    def poses_global(self) -> dict[str, SE2]:
        """Every robot as it sees itself: its own frame in the fleet's, and its own pose."""
        return {
            s["robot"]: SE2(*s["frames"][s["robot"]]) @ SE2(*s["mapping"]["pose"])
            for s in self.statuses
            if s["group"] and s["robot"] in s["frames"] and "pose" in s["mapping"]
        }

    def pose_errors(self, T_world_global: SE2 | None, group: Sequence[str]) -> dict[str, float]:
        """Where each robot of the group believes to be in the fleet's map, against where it was at that very moment."""
        if T_world_global is None:
            return {}
        errors = {}
        poses = self.poses_global()
        for s in self.statuses:
            was = self.fleet.stage.pose_at(s["robot"], s["mapping"].get("pose_stamp_s", 0.0))
            if was is not None and s["robot"] in poses and s["robot"] in group:
                errors[s["robot"]] = was.distance_m(T_world_global @ poses[s["robot"]])
        return errors

    def say(self, figures: Figures) -> None:
        if self.args.json:
            print(json.dumps({**asdict(figures), "accepted": figures.are_all_merged}, default=str))
            return
        print(figures.sentence())
        if not self.args.quiet:
            print(f"pictures: {self.args.out}/merged.png and one of each robot's own map", file=sys.stderr)


def hold_one_map(statuses: Sequence[dict[str, Any]], robots: int) -> bool:
    """Every robot is in one group and holds a global map of all of them."""
    return robots > 1 and len(statuses) == robots and all(s["global"] and len(s["global"]["members"]) == robots for s in statuses)
