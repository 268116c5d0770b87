"""Drives through simulated buildings, under conditions that a stranger would try: other LIDARs, worse wheels, people about.

`explore` yields what a robot hands on, revolution by revolution, and the truth; everything is seeded.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hw.readings import LaserScan, Odometry
from hw.sim.raycast import cast
from hw.sim.robot import DriveOptions, SimulatedRobot
from hw.sim.world import World, box, circle_points, open_world, polygon
from protocol.geometry import SE2

ODOMETRY_HZ = 50.0
BURST_EVERY_S, BURST_S, BURST_M = 30.0, 0.5, 0.25  # one wheel spins this far without grip
PERSON_RADIUS_M = 0.22


@dataclass(frozen=True, slots=True)
class Conditions:
    """One robot and what it meets."""

    range_m: float = 12.0
    beams: int = 360
    scan_hz: float = 10.0
    noise_m: float = 0.01
    lost: float = 0.0  # share of beams that do not return, at random
    black: float = 0.0  # share of walls that return nothing
    glass: float = 0.0  # share of walls that are seen through
    wheel_scale: float = 1.0  # metres told per metre rolled ...
    track_scale: float = 1.0  # ... and track believed, of the true one: turns are told smaller by this
    bursts: bool = False  # every half minute a wheel spins
    people: int = 0
    drive: DriveOptions = field(default_factory=DriveOptions)


VARIATIONS: dict[str, Conditions] = {
    "plain": Conditions(),
    "range 8 m": Conditions(range_m=8.0),
    "range 30 m": Conditions(range_m=30.0),
    "180 beams at 5 Hz": Conditions(beams=180, scan_hz=5.0),
    "1440 beams at 15 Hz": Conditions(beams=1440, scan_hz=15.0),
    "noise 3 cm": Conditions(noise_m=0.03),
    "half the beams lost": Conditions(lost=0.5),
    "black and glass walls": Conditions(black=0.1, glass=0.1, lost=0.05),
    "wheels 8 % long": Conditions(wheel_scale=1.08),
    "track 8 % wide": Conditions(track_scale=1.08),
    "slip 6 %": Conditions(drive=DriveOptions(slip=0.06, scale_error=0.03)),
    "slip bursts": Conditions(bursts=True),
    "fast": Conditions(drive=DriveOptions(speed_mps=1.0, turn_rad_s=2.0)),
    "fast at 5 Hz": Conditions(beams=180, scan_hz=5.0, drive=DriveOptions(speed_mps=1.0, turn_rad_s=2.0)),
    "eight people": Conditions(people=8),
    "cheap": Conditions(range_m=8.0, scan_hz=5.0, noise_m=0.03, lost=0.1, wheel_scale=1.06, track_scale=0.94, bursts=True),
}


@dataclass
class Wheels:
    """Encoder counts to odometry: exact arcs, as well calibrated as the conditions say."""

    robot: SimulatedRobot
    conditions: Conditions
    rng: np.random.Generator
    x_m: float = 0.0
    y_m: float = 0.0
    theta_rad: float = 0.0
    last: tuple[int, int] | None = None
    burst_s: float = math.nan
    spinning: int = 0

    def sample(self, stamp_s: float) -> Odometry:
        options = self.robot.options
        ticks = self.robot.ticks_at(stamp_s)
        last = self.last or ticks
        metres = math.tau * options.wheel_radius_m / options.ticks_per_revolution * self.conditions.wheel_scale
        rolled = [(ticks[side] - last[side]) * metres for side in (0, 1)]
        if self.conditions.bursts:
            rolled[self.spinning] += self._spun_m(stamp_s)
        turn, way = (rolled[1] - rolled[0]) / (options.track_m * self.conditions.track_scale), sum(rolled) / 2
        self.x_m += way * math.cos(self.theta_rad + turn / 2)
        self.y_m += way * math.sin(self.theta_rad + turn / 2)
        self.theta_rad += turn
        self.last = ticks
        return Odometry(stamp_s, self.x_m, self.y_m, self.theta_rad)

    def _spun_m(self, stamp_s: float) -> float:
        """What a wheel without grip turns between two samples."""
        if not stamp_s <= self.burst_s + BURST_S:
            self.burst_s = stamp_s + BURST_EVERY_S * float(self.rng.uniform(0.5, 1.5))
            self.spinning = int(self.rng.integers(2))
        return BURST_M / BURST_S / ODOMETRY_HZ if stamp_s >= self.burst_s else 0.0


class Lidar:
    """What a robot's LIDAR sees of the walls and of the people, each beam from where the robot was at its moment."""

    def __init__(self, robot: SimulatedRobot, people: list[SimulatedRobot], conditions: Conditions, seed: int) -> None:
        self.robot, self.people, self.conditions = robot, people, conditions
        self.rng = np.random.default_rng([3, seed])
        kinds = np.random.default_rng([4, seed]).random(len(robot.world.segments))
        self.solid = robot.world.segments[kinds >= conditions.glass]
        self.black = robot.world.segments[(kinds >= conditions.glass) & (kinds < conditions.glass + conditions.black)]

    def scan(self, stamp_s: float) -> LaserScan:
        c = self.conditions
        angles = np.arange(c.beams) * (math.tau / c.beams)
        offsets = np.arange(c.beams) / (c.beams * c.scan_hz)
        poses = self.robot.poses_at(stamp_s + offsets)
        bearings = poses[:, 2] + angles
        crowd = [polygon(circle_points(*self._place(person, stamp_s), PERSON_RADIUS_M)) for person in self.people]
        ranges, _ = cast(np.concatenate([self.solid, *crowd]), poses[:, :2], bearings, c.range_m)
        if len(self.black):
            ranges[cast(self.black, poses[:, :2], bearings, c.range_m)[0] <= ranges] = np.inf
        ranges = ranges + self.rng.normal(0.0, c.noise_m, c.beams)
        if c.lost:
            ranges[self.rng.random(c.beams) < c.lost] = np.inf
        return LaserScan(
            stamp_s,
            ranges.astype(np.float32),
            angles.astype(np.float32),
            0.05,
            c.range_m + 1.0,
            duration_s=1.0 / c.scan_hz,
            time_offsets_s=offsets.astype(np.float32),
        )

    @staticmethod
    def _place(person: SimulatedRobot, stamp_s: float) -> tuple[float, float]:
        pose = person.pose_at(stamp_s)
        return pose.x_m, pose.y_m


@dataclass(frozen=True, slots=True)
class Revolution:
    """What a robot hands on in one turn of its LIDAR, and the truth in the middle of it."""

    odometry: list[Odometry]  # up to the end of the turn
    scan: LaserScan
    T_world_robot: SE2


def explore(world: World, seed: int, minutes: float, conditions: Conditions) -> Iterator[Revolution]:
    """A robot explores a world by itself."""
    robot = SimulatedRobot(world, world.start_poses(1, seed)[0], seed, conditions.drive)
    walk = DriveOptions(speed_mps=1.2, turn_rad_s=3.0)
    starts = world.start_poses(1 + conditions.people, seed)[1:] if conditions.people else []
    people = [SimulatedRobot(world, start, 100 * seed + 7 + i, walk) for i, start in enumerate(starts)]
    wheels, lidar, odometry_s = (
        Wheels(robot, conditions, np.random.default_rng([5, seed])),
        Lidar(robot, people, conditions, seed),
        0.0,
    )
    for one in (robot, *people):
        one.poses_at(np.array([0.0]))
        one.begin()
    for k in range(int(minutes * 60 * conditions.scan_hz)):
        stamp_s = 0.1 + k / conditions.scan_hz
        scan = lidar.scan(stamp_s)
        samples = []
        while odometry_s <= stamp_s + 1.0 / conditions.scan_hz:
            samples.append(wheels.sample(odometry_s))
            odometry_s += 1.0 / ODOMETRY_HZ
        yield Revolution(samples, scan, robot.pose_at(stamp_s + 0.5 / conditions.scan_hz))


def long_corridor(seed: int) -> World:
    """60 x 2 m, bare but for a cupboard now and then, a room at each end."""
    rng = np.random.default_rng([31, seed])
    outline = [(0, -3), (5, -3), (5, -1), (65, -1), (65, -2.5), (71, -2.5), (71, 3), (65, 3), (65, 1), (5, 1), (5, 4), (0, 4)]
    return World.of(f"corridor?seed={seed}", [polygon(outline), *cupboards(rng, np.arange(8.0, 62.0, 6.0), -1.0, 1.0)])


def big_loop(seed: int) -> World:
    """A corridor around a block of 50 x 40 m, 2.4 m wide, with cupboards, niches and a slanted corner."""
    rng = np.random.default_rng([32, seed])
    a, b, c = rng.uniform(0.8, 2.2, 3)
    outer = [(a, 0), (54, 0), (54, 45 - b), (54 - b, 45), (0, 45), (0, c)]
    walls = [box(2.4, y, 51.6, y + 0.3) for y in np.arange(2.4, 42.4, 0.3).tolist()]  # no robot fits into the block
    shapes = [polygon(outer), *walls]
    south, north = (cupboards(rng, np.arange(4.0, 48.0, 5.0), y, y + 2.4) for y in (0.0, 42.6))
    sides = [cupboards(rng, np.arange(4.0, 38.0, 5.0), x, x + 2.4) for x in (0.0, 51.6)]
    turned = [piece[:, [1, 0, 3, 2]] for side in sides for piece in side]
    starts = [SE2(x, y, 0.0) for y in (1.2, 43.8) for x in np.arange(6.0, 50.0, 8.0).tolist()]
    return World.of(f"loop?seed={seed}", [*shapes, *south, *north, *turned], starts)


def cupboards(rng: np.random.Generator, places: NDArray[np.float64], low: float, high: float) -> list[NDArray[np.float64]]:
    """One a place along x, on either side of a corridor."""
    shapes = []
    for x in places + rng.uniform(-1.5, 1.5, len(places)):
        depth, length = rng.uniform(0.2, 0.6), rng.uniform(0.4, 1.6)
        y0, y1 = (low, low + depth) if rng.random() < 0.5 else (high - depth, high)
        shapes.append(box(float(x), float(y0), float(x + length), float(y1)))
    return shapes


BUILDINGS: dict[str, Callable[[int], World]] = {"corridor": long_corridor, "loop": big_loop}


def world_of(name: str, seed: int) -> World:
    if name in BUILDINGS:
        return BUILDINGS[name](seed)
    return open_world(f"{name}?seed={seed}" if name in ("office", "random", "outdoor") else name)
