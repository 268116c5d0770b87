"""`mapquilt export -o OUT`: a robot's map into the tools people already use: nav2, pictures, evo, Foxglove.

A running robot is asked for its map, or for the map it shares with others; without one, what was saved on disk is taken.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from agent.commands.files import saved_map, written_file
from agent.config import Config, state_dir
from agent.config_flags import add_config_arguments, load_from
from agent.exits import BAD_INPUT, OK, PEER, USAGE, CommandError
from agent.mapping.mapper import Mapper
from agent.mcap_file import McapFile
from agent.ros_frames import base_frame, map_frame
from agent.ros_messages import OCCUPANCY_GRID, PATH, TF, occupancy_grid, path, transforms
from agent.running import ask_robot, robot_socket, running_robots
from agent.runtime.packed_maps import unpacked_map
from agent.runtime.settings import mapping_options
from agent.runtime.snapshot import GLOBAL
from agent.runtime.state import StateDirectory
from agent.trajectory_files import tum_text
from agent.view.render import map_picture, png
from protocol.geometry import SE2
from protocol.grid import OccupancyGrid

EXAMPLES = """\
  mapquilt export -o today                      everything of the robot that runs here: today.yaml, .pgm, .png, .tum, .mcap
  mapquilt export -o fleet --map global         the map it shares with the others
  mapquilt export -o old --saved --id robot-2   what robot-2 saved when it last ran here
  mapquilt export -o today --formats nav2,png
"""

FORMATS = ("nav2", "png", "tum", "mcap")
NO_TRAJECTORY = np.zeros((0, 4))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="OUT", help="base name of what is written")
    parser.add_argument(
        "--formats", default=",".join(FORMATS), metavar="LIST", help=f"some of {','.join(FORMATS)} (default: all)"
    )
    parser.add_argument("--map", metavar="NAME", help="global, or a robot's id (default: the robot's own map)")
    parser.add_argument("--robot", metavar="ID", help="which robot, when several run here")
    parser.add_argument("--saved", action="store_true", help="take what is on disk, even when the robot runs")
    add_config_arguments(parser, "robot.id", "state")


@dataclass(frozen=True, slots=True, eq=False)
class Exported:
    """What there is to write; poses and trajectory are in the grid's map frame."""

    robot: str
    map_name: str
    grid: OccupancyGrid
    poses: Mapping[str, SE2] = field(default_factory=dict)
    frames: Mapping[str, SE2] = field(default_factory=dict)  # T_map_othermap of the robots whose maps lie on this one
    trajectory: NDArray[np.float64] = field(default_factory=lambda: NO_TRAJECTORY)  # (N, 4) stamp, x, y, theta


def run(args: argparse.Namespace) -> int:
    formats = args.formats.split(",")
    wrong = [name for name in formats if name not in FORMATS]
    if wrong:
        raise CommandError(f"export: unknown format '{wrong[0]}'; choose from {', '.join(FORMATS)}", USAGE)
    config = load_from(args).config
    is_live = not args.saved and (args.robot is not None or bool(running_robots()))
    exported = from_running(args.robot, args.map, config) if is_live else from_disk(config, args.map)
    for written in write(exported, args.output, formats, quiet=args.quiet):
        if not args.quiet:
            print(f"wrote {written}", file=sys.stderr)
    return OK


def from_disk(config: Config, map_name: str | None = None) -> Exported:
    """The saved local map, its robot and its trajectory."""
    robot, folder = config.robot.id, state_dir(config, os.environ)
    if map_name not in (None, robot):
        raise CommandError(f"export: only {robot}'s own map is on disk; '{map_name}' can be asked of a running robot", USAGE)
    saved = StateDirectory(folder).load("mapper")
    if saved is None:
        raise CommandError(f"{folder}: no saved map of {robot}; give --id or --state-dir, or start the robot", BAD_INPUT)
    try:
        mapper = Mapper.restore(saved, mapping_options(config))
    except Exception as error:  # whatever another version wrote
        raise CommandError(f"{folder}: the saved map does not fit this program and these settings: {error}", BAD_INPUT) from error
    estimate = mapper.estimate()
    return Exported(robot, robot, estimate.grid, {robot: estimate.T_map_robot}, {}, mapper.map.trajectory())


def from_running(robot: str | None, map_name: str | None, config: Config) -> Exported:
    """The map a running robot shows; its trajectory comes from the state it saves when asked."""
    name, socket = robot_socket(robot)
    status = ask_robot(socket, "status")["status"]
    wanted = map_name or name
    if wanted not in status["maps"]:
        raise CommandError(f"{name} has no map '{wanted}'; it has {', '.join(status['maps']) or 'none yet'}", PEER)
    grid = unpacked_map(ask_robot(socket, "map", name=wanted)["map"])
    T_global = {other: SE2(*pose) for other, pose in status["frames"].items()}
    T_map_global = SE2.identity() if wanted == GLOBAL else T_global.get(wanted, SE2.identity()).inverse()
    frames = {other: T_map_global @ T for other, T in T_global.items() if wanted == GLOBAL or other != wanted}
    poses = {other: T_map_global @ T_global[other] @ SE2(*pose) for other, pose in status["poses"].items() if other in T_global}
    trajectory = NO_TRAJECTORY
    if wanted == name:
        try:
            ask_robot(socket, "save")
            trajectory = from_disk(replace(config, robot=replace(config.robot, id=name))).trajectory
        except CommandError:
            trajectory = NO_TRAJECTORY  # it keeps no state, or not where these settings say
    return Exported(name, wanted, grid, poses, frames, trajectory)


def write(exported: Exported, output: Path, formats: list[str], *, quiet: bool = False) -> list[Path]:
    """Each format into its file; a trajectory that nobody kept is said and left out."""
    written: list[Path] = []
    if "nav2" in formats:
        written += saved_map(exported.grid, output)
    if "png" in formats:
        written.append(written_file(_named(output, ".png"), png(map_picture(exported.grid, exported.poses))))
    if "tum" in formats:
        if len(exported.trajectory):
            written.append(written_file(_named(output, ".tum"), tum_text(exported.trajectory).encode()))
        elif not quiet:
            print(f"mapquilt: no trajectory of '{exported.map_name}' was kept, so there is no .tum", file=sys.stderr)
    if "mcap" in formats:
        written.append(written_file(_named(output, ".mcap"), as_mcap(exported)))
    return written


def as_mcap(exported: Exported) -> bytes:
    """/NAME/map, /NAME/path, and the frames: this map's is the parent of every other robot's map and of the robots."""
    mcap, frame = McapFile(), map_frame(exported.map_name)
    stamps = exported.trajectory[:, 0].tolist()
    poses = [SE2(x, y, theta) for _, x, y, theta in exported.trajectory.tolist()]
    first_s, last_s = (stamps[0], stamps[-1]) if stamps else (0.0, 0.0)
    mcap.add(f"/{exported.map_name}/map", OCCUPANCY_GRID, first_s, occupancy_grid(exported.grid, first_s, frame))
    if poses:
        mcap.add(f"/{exported.map_name}/path", PATH, last_s, path(stamps, poses, frame))
    still = [(frame, map_frame(other), T) for other, T in exported.frames.items()]
    still += [(frame, base_frame(other), T) for other, T in exported.poses.items() if other != exported.robot or not poses]
    if still:
        mcap.add("/tf", TF, first_s, transforms(first_s, still))
    for stamp_s, pose in zip(stamps, poses, strict=True):
        mcap.add("/tf", TF, stamp_s, transforms(stamp_s, [(frame, base_frame(exported.robot), pose)]))
    return mcap.encoded()


def _named(output: Path, suffix: str) -> Path:
    """OUT with a suffix of its own; dots in OUT stay."""
    base = output.with_suffix("") if output.suffix in (".yaml", ".pgm", ".png", ".tum", ".mcap") else output
    return base.with_name(base.name + suffix)
