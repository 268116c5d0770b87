"""One simulated drive, written down in every dialect of CARMEN logs, and the map that `mapquilt map` draws of each.

    .venv/bin/python -m tests.bench.carmen_dialects [--minutes 5] [--world office] [--seed 1] [--json]

The wheels are badly calibrated (3 % long, track 3 % wide), and the poses of the corrected dialects are true but for a jitter.  A
row a dialect: where the motion was found, and the share of known cells that are right (a wall may lie one cell off).
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from agent.commands.map import draw
from agent.mapping.options import MappingOptions
from agent.recordings import open_recording
from hw.sim.raycast import cast
from hw.sim.robot import SimulatedRobot
from hw.sim.world import World
from protocol.geometry import SE2
from tests.bench.mapping_drives import Conditions, Wheels, world_of
from tests.bench.mapping_worlds import cells_right
from tests.bench.tables import heading, line

OFFSET = SE2(0.2, 0.0, 0.0)  # of the LIDAR, in the dialects that can tell it
SCAN_HZ, ODOM_PER_SCAN = 5.0, 4
RANGE_M, EPOCH_S = 30.0, 1_000_000_000.0


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """One scan, the ODOM samples up to it, and the truth."""

    stamp_s: float
    odometry: list[tuple[float, SE2]]  # the last one at the scan
    true: SE2
    ranges_m: NDArray[np.float64]  # of a LIDAR in the middle
    offset_ranges_m: NDArray[np.float64]  # of a LIDAR at OFFSET


def moments(world: World, seed: int, minutes: float, beams: int) -> Iterator[Moment]:
    """A robot explores a world, seen by a LIDAR of 180 degrees."""
    robot = SimulatedRobot(world, world.start_poses(1, seed)[0], seed)
    conditions = Conditions(wheel_scale=1.03, track_scale=1.03)
    wheels, rng = Wheels(robot, conditions, np.random.default_rng([5, seed])), np.random.default_rng([7, seed])
    robot.poses_at(np.array([0.0]))
    robot.begin()
    for k in range(int(minutes * 60 * SCAN_HZ)):
        stamps = [(k * ODOM_PER_SCAN + i + 1) / (SCAN_HZ * ODOM_PER_SCAN) for i in range(ODOM_PER_SCAN)]
        samples = [wheels.sample(stamp_s) for stamp_s in stamps]
        true = robot.pose_at(stamps[-1])
        views = [_view(world, pose, beams, rng) for pose in (true, true @ OFFSET)]
        yield Moment(stamps[-1], [(s.stamp_s, SE2(s.x_m, s.y_m, s.theta_rad)) for s in samples], true, *views)


def _view(world: World, pose: SE2, beams: int, rng: np.random.Generator) -> NDArray[np.float64]:
    bearings = pose.theta_rad + np.linspace(-math.pi / 2, math.pi / 2, beams)
    ranges, _ = cast(world.segments, np.tile([pose.x_m, pose.y_m], (beams, 1)), bearings, RANGE_M)
    return np.where(np.isfinite(ranges), ranges + rng.normal(0.0, 0.01, beams), 81.91)


def _pose(pose: SE2) -> str:
    return f"{pose.x_m:.6f} {pose.y_m:.6f} {pose.theta_rad:.6f}"


def _odom(stamp_s: float, pose: SE2) -> str:
    return f"ODOM {_pose(pose)} 0.0 0.0 0.0 {EPOCH_S + stamp_s:.6f} robot {stamp_s:.6f}"


def _flaser(stamp_s: float, ranges: NDArray[np.float64], laser: SE2, robot: SE2) -> str:
    beams = " ".join(f"{r:.2f}" for r in ranges)
    return f"FLASER {len(ranges)} {beams} {_pose(laser)} {_pose(robot)} {EPOCH_S + stamp_s:.6f} robot {stamp_s:.6f}"


def _configured(kind: str, m: Moment, ranges: NDArray[np.float64], poses: str) -> str:
    beams, step = " ".join(f"{r:.3f}" for r in ranges), math.pi / (len(ranges) - 1)
    setup = f"0 {-math.pi / 2:.6f} {math.pi:.6f} {step:.6f} 81.920000 0.010000 0"
    return f"{kind} {setup} {len(ranges)} {beams} 0 {poses}{EPOCH_S + m.stamp_s:.6f} robot {m.stamp_s:.6f}"


def corrected(drive: list[Moment]) -> Iterator[str]:
    """As Radish has them: the odometry begins again at every corrected pose; a scan a third of a metre."""
    rng, pose, raw, last = np.random.default_rng(9), SE2.identity(), SE2.identity(), SE2(math.inf, 0.0, 0.0)
    for m in drive:
        for stamp_s, odom in m.odometry:
            yield _odom(stamp_s, pose @ raw.inverse() @ odom)
        if m.true.distance_m(last) < 0.3 and abs(math.remainder(m.true.theta_rad - last.theta_rad, math.tau)) < 0.3:
            continue
        last, raw = m.true, m.odometry[-1][1]
        pose = m.true @ SE2(*rng.normal(0.0, (0.02, 0.02, 0.005)))
        yield _flaser(m.stamp_s, m.ranges_m, pose, pose)
        yield f"ODOM {_pose(pose)} 0 0 0 0 robot 0"
        yield "NEFF 27.3"


def raw(drive: list[Moment]) -> Iterator[str]:
    """ODOM as it comes, and scans with the odometry of their moment."""
    yield "# message formats defined: PARAM SYNC ODOM FLASER RLASER TRUEPOS"
    yield "SYNC start 0 robot 0"
    for m in drive:
        yield from (_odom(*sample) for sample in m.odometry[:-1])
        yield _flaser(m.stamp_s, m.offset_ranges_m, m.odometry[-1][1] @ OFFSET, m.odometry[-1][1])
        yield f"RLASER 4 1 1 1 1 {_pose(m.true)} {_pose(m.true)} {EPOCH_S + m.stamp_s:.6f} robot {m.stamp_s:.6f}"
        yield _odom(*m.odometry[-1])


def scans_only(drive: list[Moment]) -> Iterator[str]:
    """Odometry in the last three numbers of each scan, a corrected pose in the first three; no ODOM lines."""
    yield from (_flaser(m.stamp_s, m.ranges_m, m.true, m.odometry[-1][1]) for m in drive)


def raw_scans_only(drive: list[Moment]) -> Iterator[str]:
    """The same, with odometry in both; the stamps of the driver are none."""
    for m in drive:
        words = _flaser(m.stamp_s, m.ranges_m, m.odometry[-1][1], m.odometry[-1][1]).split()
        yield " ".join([*words[:-3], "1.07e+09", *words[-2:]])


def odometry_apart(drive: list[Moment]) -> Iterator[str]:
    """ODOM goes on by itself, both poses of a scan are corrected; no stamps at all."""
    for m in drive:
        yield from (" ".join([*_odom(*sample).split()[:-3], "0", "robot", "0"]) for sample in m.odometry)
        yield " ".join([*_flaser(m.stamp_s, m.ranges_m, m.true, m.true).split()[:-3], "0", "robot", "0"])


def robotlaser(drive: list[Moment]) -> Iterator[str]:
    """The new format of CARMEN, odometry in the scans only; RAWLASER1 beside it."""
    for m in drive:
        poses = f"{_pose(m.odometry[-1][1] @ OFFSET)} {_pose(m.odometry[-1][1])} 0.3 0.0 0.0 0.0 0.0 "
        yield _configured("RAWLASER1", m, m.offset_ranges_m, "")
        yield _configured("ROBOTLASER1", m, m.offset_ranges_m, poses)


def rawlaser(drive: list[Moment]) -> Iterator[str]:
    """Scans without poses, and ODOM."""
    yield f"PARAM robot_frontlaser_offset {OFFSET.x_m} robot 0"
    for m in drive:
        yield from (_odom(*sample) for sample in m.odometry)
        yield _configured("RAWLASER1", m, m.offset_ranges_m, "")


def laser_reading(drive: list[Moment]) -> Iterator[str]:
    """GMapping's own log."""
    for m in drive:
        beams = " ".join(f"{r:.2f}" for r in m.ranges_m)
        yield f"ODO_UPDATE 1 {_pose(m.true)} 0.0 {m.stamp_s:.6f}"
        yield f"LASER_READING {len(m.ranges_m)} {beams} {_pose(m.odometry[-1][1])} {m.stamp_s:.6f}"


def corrected_only(drive: list[Moment]) -> Iterator[str]:
    """No odometry anywhere: poses of a filter."""
    yield "NEFF 27.3"
    yield from (_flaser(m.stamp_s, m.ranges_m, m.true, m.true) for m in drive)


DIALECTS: dict[str, Callable[[list[Moment]], Iterator[str]]] = {
    function.__name__: function
    for function in (
        corrected, raw, scans_only, raw_scans_only, odometry_apart, robotlaser, rawlaser, laser_reading, corrected_only
    )
}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--world", default="office")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--beams", type=int, default=181)
    parser.add_argument("--dialects", default=",".join(DIALECTS))
    parser.add_argument("--keep", type=Path, help="a folder to write the logs to")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    world = world_of(args.world, args.seed)
    drive = list(moments(world, args.seed, args.minutes, args.beams))
    columns = ("dialect", "odometry", "scans", "cells_right", "known_m2", "begun_anew", "cpu_ms_per_scan")
    if not args.json:
        print(heading(columns))
    for name in args.dialects.split(","):
        with tempfile.TemporaryDirectory() as scratch:
            log = (args.keep or Path(scratch)) / f"{name}.log"
            log.write_text("\n".join(DIALECTS[name](drive)) + "\n")
            row = judged(name, log, world, drive[0].true)
        print(json.dumps(row) if args.json else line(row, columns), flush=True)


def judged(name: str, log: Path, world: World, start: SE2) -> dict[str, object]:
    """The map of one log beside the truth."""
    recording = open_recording(log)
    options = MappingOptions(T_base_laser=recording.T_base_laser or SE2.identity())
    drawn = draw(recording, options, 0)
    return {
        "dialect": name,
        "odometry": recording.odometry,
        "scans": drawn.scans,
        "cells_right": round(cells_right(drawn.estimate.grid, start, world), 5),
        "known_m2": round(drawn.estimate.grid.known_area_m2()),
        "begun_anew": drawn.begun_anew,
        "cpu_ms_per_scan": round(1e3 * drawn.cpu_s / drawn.scans, 1),
    }


if __name__ == "__main__":
    main()
