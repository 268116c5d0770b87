"""`mapquilt sim DEVICE --link PATH`: a simulated sensor on a pseudo-terminal, for people without hardware and other software."""

from __future__ import annotations

import argparse
import math
import os
import shlex
import signal
import threading
from dataclasses import replace
from pathlib import Path
from typing import cast

from agent.arguments import number, whole
from agent.exits import OK, USAGE, CommandError
from hw.errors import DeviceConfigError
from hw.sim.bases_sim import Counter
from hw.sim.catalogue import BASES, LIDARS, NAMES, USUAL, device_url
from hw.sim.devices import ByteDevice
from hw.sim.faults import KINDS, RATES, FaultyDevice, Schedule
from hw.sim.obedient import ObedientRobot
from hw.sim.pty_port import PtyServer
from hw.sim.robot import DriveOptions, SimulatedRobot
from hw.sim.sight import PoseSource, Sight
from hw.sim.world import MAX_EXTENT_M, World, open_world
from protocol.geometry import SE2

EXAMPLES = """\
  mapquilt sim rplidar-a1 --link /tmp/lidar                        an RPLIDAR that stands in an office
  mapquilt sim ld06 --link /tmp/lidar --explore --also wt1=/tmp/wheels
                                                                   a robot that explores: LIDAR and wheel encoders
  mapquilt sim hokuyo-utm --link /tmp/lidar --world room.txt --pose 2,1.5,90 --noise 0
  mapquilt sim xv11 --link /tmp/lidar --fault drop@5:20,stall@10:2,unplug@15:3
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `mapquilt sim`."""
    parser.add_argument("device", metavar="DEVICE", help=f"one of {', '.join(NAMES)}")
    parser.add_argument(
        "--link", metavar="PATH", required=True, type=Path, help="the port appears here, and again here after a replug"
    )
    parser.add_argument(
        "--also", metavar="DEVICE=PATH", action="append", default=[], help="another device of the same robot; may be repeated"
    )
    parser.add_argument(
        "--world",
        default="office",
        help="office, outdoor, random, each with ?seed=N, or a file of walls: 'x0 y0 x1 y1' a line, metres",
    )
    parser.add_argument(
        "--pose", metavar="X,Y,DEG", help="where the robot stands, or starts (default: a free place in the world)"
    )
    parser.add_argument(
        "--noise", metavar="METRES", type=number(0, 10), default=0.01, help="one sigma of a range; 0: exact (default 0.01)"
    )
    parser.add_argument(
        "--explore", action="store_true", help="the robot drives around by itself, not into walls (else: as its base is told)"
    )
    parser.add_argument(
        "--speed",
        metavar="M/S",
        type=number(0.01, 2),
        default=USUAL.speed_mps,
        help="of the exploring robot (default %(default)s)",
    )
    parser.add_argument(
        "--fault",
        metavar="SCHEDULE",
        default="",
        help=f"KIND@SECONDS[:VALUE] or RATE=..., with commas; kinds: {', '.join(KINDS)}; rates: {', '.join(RATES)}",
    )
    parser.add_argument("--seed", type=whole(0), default=0, help="of noise, faults and the way the robot takes")
    parser.add_argument("--seconds", type=number(0), help="end after so long (default: when stopped)")
    parser.add_argument(
        "--mirrored", action="store_true", help="turn the scan the wrong way round: to see that a check of it can fail"
    )


def run(args: argparse.Namespace) -> int:
    """Serve until stopped."""
    try:
        served = _devices(args)
        lines = [(FaultyDevice(device, Schedule.parse(args.fault), args.seed), path) for _, device, path in served]
    except DeviceConfigError as error:
        raise CommandError(str(error), USAGE) from error
    stop = threading.Event()
    for ending in (signal.SIGINT, signal.SIGTERM):
        signal.signal(ending, lambda *_: stop.set())
    try:
        with PtyServer(lines):
            if not args.quiet:
                for name, _, path in served:
                    print(
                        f"{path} -> {os.path.realpath(path)}  {name}; use it as {shlex.quote(device_url(name, path))}", flush=True
                    )
            stop.wait(args.seconds)
    except OSError as error:
        raise CommandError(
            f"{error.filename or args.link}: {error.strerror or error}; the folder must exist, the name must be free", USAGE
        ) from error
    return OK


def _devices(args: argparse.Namespace) -> list[tuple[str, ByteDevice, Path]]:
    """(name, device, link) of all devices asked for, on one robot."""
    asked = [(args.device, args.link), *(_also(entry) for entry in args.also)]
    for name, _ in asked:
        if name not in NAMES:
            raise DeviceConfigError(f"{name}: no such device; there are {', '.join(NAMES)}")
    links = [path.absolute() for _, path in asked]
    for path in links:
        if links.count(path) > 1:
            raise DeviceConfigError(f"{path}: two devices cannot share a port; give each a PATH of its own")
    world = open_world(args.world)
    pose = _pose(args.pose) if args.pose else world.start_poses(1, args.seed)[0]
    base = _base(args, world, pose, next((BASES[name].drive for name, _ in asked if name in BASES), USUAL))
    return [(name, _device(name, base, args), path) for name, path in asked]


def _also(entry: str) -> tuple[str, Path]:
    name, equals, path = entry.partition("=")
    if not equals or not path:
        raise DeviceConfigError(f"--also {entry}: write it as DEVICE=PATH, for example wt1=/tmp/wheels")
    return name, Path(path)


def _pose(text: str) -> SE2:
    try:
        x_m, y_m, heading_deg = (float(word) for word in text.split(","))
    except ValueError:
        x_m = y_m = heading_deg = math.nan
    if not (abs(x_m) <= MAX_EXTENT_M and abs(y_m) <= MAX_EXTENT_M and math.isfinite(heading_deg)):
        raise DeviceConfigError(
            f"--pose {text}: write it as x,y,degrees, for example 2,1.5,90; x and y at most {MAX_EXTENT_M:g} m from 0,0"
        )
    return SE2(x_m, y_m, math.radians(heading_deg))


def _base(args: argparse.Namespace, world: World, pose: SE2, drive: DriveOptions) -> PoseSource:
    """What the devices sit on."""
    if not args.explore:
        return ObedientRobot(world, pose, drive)
    robot = SimulatedRobot(world, pose, args.seed, replace(drive, speed_mps=args.speed))
    robot.begin()
    return robot


def _device(name: str, base: PoseSource, args: argparse.Namespace) -> ByteDevice:
    if name in BASES:
        return BASES[name].make(cast(Counter, base))
    return LIDARS[name][0](Sight(base, args.noise, seed=args.seed, is_mirrored=args.mirrored))
