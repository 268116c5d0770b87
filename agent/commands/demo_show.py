"""What a person sees of the demo while it runs, and what is drawn and written down when it is over."""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from agent.commands.demo_figures import Figures, agreement, aligned
from agent.commands.demo_fleet import Fleet
from agent.view.render import map_picture, png
from protocol.geometry import SE2
from protocol.grid import OccupancyGrid

LOOK_EVERY_S = 0.5
SAY_EVERY_S = 5.0  # where lines stay


class Show:
    """Looks at the fleet, says how it goes, and draws what came of it."""

    def __init__(self, args: argparse.Namespace, fleet: Fleet) -> None:
        self.args, self.fleet = args, fleet
        self.merged_after_s: float | None = None
        self.statuses: list[dict[str, Any]] = []
        self.said_s = -SAY_EVERY_S
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
        elif elapsed_s - self.said_s >= SAY_EVERY_S:
            self.said_s = elapsed_s
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
        global_poses = self.poses_global(best)
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
            pose_errors_m=self.pose_errors(T_world_global, global_poses),
            scans=self.scans()[0],
            scans_lost=self.scans()[1],
        )

    def scans(self) -> tuple[int, int]:
        """How many scans came, and how many came too fast."""
        mappings = [s["mapping"] for s in self.statuses]
        return sum(m["scans"] for m in mappings), sum(m["scans_lost"] for m in mappings)

    def fused(self, robot: str) -> OccupancyGrid | None:
        return next(agent for agent in self.fleet.agents if agent.robot == robot).grid()

    def poses_global(self, best: Mapping[str, Any]) -> dict[str, SE2]:
        """Every robot of the best one's group as it sees itself: its frame in the fleet's, and its own pose.

        A robot that has just lost sight of the others has another fleet's frame; where its map lies, the best one says.
        """
        poses = {}
        for s in self.statuses:
            frames = s["frames"] if s["root"] == best["root"] else best["frames"]
            if s["robot"] in best["group"] and s["robot"] in frames and "pose" in s["mapping"]:
                poses[s["robot"]] = SE2(*frames[s["robot"]]) @ SE2(*s["mapping"]["pose"])
        return poses

    def pose_errors(self, T_world_global: SE2 | None, poses: Mapping[str, SE2]) -> dict[str, float]:
        """Where each robot believes to be in the fleet's map, against where it was at that very moment."""
        if T_world_global is None:
            return {}
        errors = {}
        for s in self.statuses:
            was = self.fleet.stage.pose_at(s["robot"], s["mapping"].get("pose_stamp_s", 0.0))
            if was is not None and s["robot"] in poses:
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
