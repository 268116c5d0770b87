"""`mapquilt map LOG -o OUT`: a recording into a map, from its raw odometry and scans, as a robot would have drawn it."""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from agent.arguments import whole
from agent.commands.files import saved_map, writable, written_file
from agent.exits import BAD_INPUT, NEGATIVE, OK, USAGE, CommandError
from agent.mapping.estimate import MapEstimate
from agent.mapping.mapper import Mapper
from agent.mapping.options import MappingOptions
from agent.recordings import Readings, RecordingError, open_recording
from agent.runtime.own_loops import fit_in_own_map
from agent.terminal import Progress
from agent.trajectory_files import tum_text
from agent.view.render import map_picture, pixel_of, png, scale_for
from hw.readings import Odometry
from protocol.geometry import SE2

EXAMPLES = """\
  mapquilt map intel.log.gz -o intel        intel.pgm and intel.yaml (nav2), intel.png, intel.tum (trajectory)
  mapquilt map drive.mcap -o drive          rosbag2 and MCAP with LaserScan and Odometry: needs the package rosbags
  mapquilt map run.clf -o run --json        ... and figures as one JSON object
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("log", type=Path, metavar="LOG", help="CARMEN log (.log, .clf, .gz), .mcap, rosbag2 directory, .bag")
    parser.add_argument("-o", "--output", type=Path, metavar="OUT", help="base name of what is written (default: the log's name)")
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout")
    parser.add_argument("--particles", type=int, metavar="N", help="hypotheses of the particle filter (default: 30)")
    parser.add_argument("--resolution", type=float, metavar="METRES", help="cell size (default: 0.05)")
    parser.add_argument("--max-range", type=float, metavar="METRES", help="longer beams are cut (default: 25)")
    parser.add_argument("--seed", type=whole(0), default=0, metavar="N", help="the same log and seed give the same map")
    parser.add_argument(
        "--mount", metavar="X,Y,DEG", help="where the LIDAR sits on the robot (default: what the log says, else 0,0,0)"
    )
    parser.add_argument("--scan-topic", metavar="NAME", help="of a bag with several LaserScan topics")
    parser.add_argument("--odom-topic", metavar="NAME", help="of a bag with several Odometry topics")


@dataclass(frozen=True, slots=True, eq=False)
class Drawn:
    """What came of a recording."""

    estimate: MapEstimate
    trajectory: NDArray[np.float64]  # (N, 4) stamp, x, y, theta
    scans: int
    cpu_s: float
    begun_anew: int
    loops_closed: int


def run(args: argparse.Namespace) -> int:
    options = _options(args)
    if args.output is not None:
        writable(args.output)
    try:
        recording = open_recording(args.log, args.scan_topic, args.odom_topic)
    except RecordingError as error:
        raise CommandError(str(error), BAD_INPUT) from error
    if args.mount is None and recording.T_base_laser is not None:
        options = replace(options, T_base_laser=recording.T_base_laser)
    drawn = draw(recording, options, args.seed, shows_progress=not (args.quiet or args.json))
    if not len(drawn.trajectory):
        raise CommandError(
            f"{args.log}: {drawn.scans} scans, and not one could be drawn; is the LIDAR's range in metres?", BAD_INPUT
        )
    if drawn.begun_anew and not any(isinstance(reading, Odometry) for reading in recording.readings):
        raise CommandError(
            f"{args.log}: no raw odometry in it, and its scans are too far apart to follow without: lost {drawn.begun_anew} times"
            f" in {drawn.scans} scans; nothing is written",
            BAD_INPUT,
        )
    base = args.output or Path(recording.name)
    written = write(base, recording, drawn)
    figures = as_json(recording, drawn)
    print(json.dumps(figures) if args.json else as_text(figures))
    if not args.quiet:
        told = [f"odometry: {recording.odometry}"] if recording.odometry else []
        print("\n".join([*told, *(f"wrote {path}" for path in written)]), file=sys.stderr)
    return OK if drawn.estimate.grid.known_area_m2() > 0 else NEGATIVE


def draw(recording: Readings, options: MappingOptions, seed: int, *, shows_progress: bool = False) -> Drawn:
    """Feed everything to a mapper, as fast as it goes."""
    cv2.setNumThreads(1)
    mapper = Mapper(options, seed, fit_in_own_map)
    progress = Progress(recording.name, shown=shows_progress)
    scans, started_s = 0, time.process_time()
    for i, reading in enumerate(recording.readings):
        if isinstance(reading, Odometry):
            mapper.add_odometry(reading)
            continue
        scans += 1
        outcome = mapper.add_scan(reading)
        progress.at((i + 1) / len(recording.readings), outcome.status.value)
    mapper.finish()
    progress.done()
    cpu_s = time.process_time() - started_s
    return Drawn(mapper.estimate(), mapper.map.trajectory(), scans, cpu_s, mapper.epoch, mapper.loops_closed)


def write(base: Path, recording: Readings, drawn: Drawn) -> list[Path]:
    """The map, the trajectory, and a picture of both."""
    stem = base.with_suffix("") if base.suffix in (".yaml", ".pgm", ".png", ".tum") else base
    written = saved_map(drawn.estimate.grid, stem)
    tum = tum_text(drawn.trajectory, recording.first_stamp_s)
    written.append(written_file(stem.with_name(stem.name + ".tum"), tum.encode()))
    written.append(written_file(stem.with_name(stem.name + ".png"), picture(drawn)))
    return written


def picture(drawn: Drawn) -> bytes:
    grid = drawn.estimate.grid
    canvas = map_picture(grid, {"end": drawn.estimate.T_map_robot})
    scale = scale_for(grid)
    points = [pixel_of(grid, (x, y), scale) for x, y in drawn.trajectory[:, 1:3].tolist()]
    cv2.polylines(canvas, [np.array(points, np.int32)], False, (200, 120, 40), 1, cv2.LINE_AA)
    return png(canvas)


def as_json(recording: Readings, drawn: Drawn) -> dict[str, float | str]:
    grid, path = drawn.estimate.grid, drawn.trajectory
    return {
        "log": recording.name,
        "odometry": recording.odometry,
        "scans": drawn.scans,
        "scans_placed": len(path),
        "duration_s": round(float(path[-1, 0] - path[0, 0]), 2),
        "distance_m": round(float(np.hypot(*np.diff(path[:, 1:3], axis=0).T).sum()), 2),
        "known_m2": round(grid.known_area_m2(), 2),
        "width_m": round(grid.width * grid.resolution_m, 2),
        "height_m": round(grid.height * grid.resolution_m, 2),
        "cpu_ms_per_scan": round(1e3 * drawn.cpu_s / max(drawn.scans, 1), 3),
        "begun_anew": drawn.begun_anew,
        "loops_closed": drawn.loops_closed,
    }


def as_text(figures: dict[str, float | str]) -> str:
    anew = f"; the robot was lost and began a new map {figures['begun_anew']} times" if figures["begun_anew"] else ""
    loops = f"; {figures['loops_closed']} missed loops closed" if figures["loops_closed"] else ""
    return (
        f"{figures['log']}: {figures['known_m2']} m2 known on {figures['width_m']} x {figures['height_m']} m, from"
        f" {figures['scans_placed']} of {figures['scans']} scans over {figures['distance_m']} m in {figures['duration_s']} s,"
        f" {figures['cpu_ms_per_scan']} ms CPU a scan{loops}{anew}"
    )


def _options(args: argparse.Namespace) -> MappingOptions:
    chosen: dict[str, object] = {}
    for flag, name, value, low, high in (
        ("--particles", "particles", args.particles, 1, 1000),
        ("--resolution", "resolution_m", args.resolution, 0.01, 1.0),
        ("--max-range", "matching_range_m", args.max_range, 1.0, 500.0),
    ):
        if value is not None:
            if not low <= value <= high:
                raise CommandError(f"map: {flag} {value:g}: expected {low:g} to {high:g}", USAGE)
            chosen[name] = value
    if args.mount is not None:
        chosen["T_base_laser"] = _mount(args.mount)
    return MappingOptions(**chosen)  # type: ignore[arg-type]


def _mount(text: str) -> SE2:
    try:
        x_m, y_m, yaw_deg = (float(part) for part in text.split(","))
    except ValueError as error:
        raise CommandError(f"map: --mount {text}: expected x,y,degrees, as in --mount 0.1,0,180", USAGE) from error
    if not all(map(math.isfinite, (x_m, y_m, yaw_deg))):
        raise CommandError(f"map: --mount {text}: expected x,y,degrees, as in --mount 0.1,0,180", USAGE)
    return SE2(x_m, y_m, math.radians(yaw_deg))
