"""What the demo's robots sense: a simulated world they drive through, or a recording cut in parts, each behind real ptys.

Either way a robot is a pair of serial devices, and the process that maps with them cannot tell the difference.
"""

from __future__ import annotations

import contextlib
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from hw.carmen import read_recording
from hw.sim.catalogue import BASES, LIDARS
from hw.sim.devices import ByteDevice, SickScanner
from hw.sim.pty_port import TICK_S, PtyServer
from hw.sim.replay import Replay, ReplayBoard, ReplayScans
from hw.sim.robot import SimulatedRobot
from hw.sim.sight import Sight
from hw.sim.world import World, open_world
from protocol.geometry import SE2
from protocol.grid import OccupancyGrid

REPLAY_SPEED = 8.0  # a recording of half an hour in a minute: scans come at about 9 Hz
REPLAY_V_MAX_MPS = 50
MERGE_WITHIN_S = 50.0
FEW_ROBOTS, MERGE_S_A_ROBOT = 6, 6.0  # more of them share a computer's cores and meet later: 20 on two cores after 100 s
TICK_PER_ROBOT_S = (
    0.0025  # bytes of many robots move in larger portions: every 50 ms costs 1.9 % of a core each, every 10 ms 5.1 %
)
LONGEST_TICK_S = 0.05
START_SPACING_M = 4.5  # of way between neighbours: another room, and a corridor both will see
SETTLE_S = 25.0  # after the last recorded scan, for the last and largest maps to be compared and to travel


@dataclass(frozen=True, slots=True)
class Actor:
    """A robot's name and how its agent is told where its devices are."""

    name: str
    lidar_url: str
    wheels_url: str
    settings: tuple[str, ...] = ()

    def arguments(self) -> list[str]:
        """Command line of its `mapquilt run`."""
        words = ["--lidar", self.lidar_url, "--wheels", self.wheels_url]
        return words + [word for setting in self.settings for word in ("--set", setting)]


class Stage(Protocol):
    """Where the demo plays.  Use it in a `with`; `begin` once the robots' agents are up."""

    @property
    def robots(self) -> list[Actor]: ...

    def __enter__(self) -> Stage: ...

    def __exit__(self, *exc: object) -> None: ...

    def begin(self) -> None: ...

    def duration_s(self) -> float | None:
        """From `begin` until there is nothing new to sense; None: as long as one likes."""

    def time_limit_s(self) -> float:
        """From `begin` until nothing new is worth waiting for."""

    def truth(self) -> OccupancyGrid | None:
        """The map a perfect robot would draw; None when nobody knows."""

    def start_pose(self, robot: str) -> SE2 | None:
        """Where a robot started in the world."""

    def pose_at(self, robot: str, stamp_s: float) -> SE2 | None:
        """Where it truly was at a moment."""


def open_stage(world: str, n: int, seed: int, folder: Path, prefix: str = "robot") -> Stage:
    """`world`: as in `mapquilt demo --world`; devices appear as links in `folder`.  DeviceConfigError when it cannot be."""
    if world.startswith("log:"):
        return RecordedStage(world.removeprefix("log:"), n, folder, prefix)
    return SimulatedStage(
        open_world(world if "?" in world or Path(world).is_file() else f"{world}?seed={seed}"), n, seed, folder, prefix
    )


class SimulatedStage:
    """Robots that explore one world by themselves."""

    def __init__(self, world: World, n: int, seed: int, folder: Path, prefix: str) -> None:
        self._world = world
        starts = world.start_poses(n, seed, START_SPACING_M)
        self._by_name = {f"{prefix}-{i + 1}": SimulatedRobot(world, starts[i], 64 * seed + i) for i in range(n)}
        self._lines = Lines(folder, min(LONGEST_TICK_S, n * TICK_PER_ROBOT_S))
        self.robots = [self._actor(name, robot, 64 * seed + i) for i, (name, robot) in enumerate(self._by_name.items())]

    def _actor(self, name: str, robot: SimulatedRobot, seed: int) -> Actor:
        lidar, wheels = self._lines.add(name, LIDARS["ld06"][0](Sight(robot, seed=seed)), BASES["wt1"].make(robot))
        return Actor(name, f"ld06:{lidar}", f"wheels:{wheels}")

    def __enter__(self) -> SimulatedStage:
        self._lines.open()
        return self

    def __exit__(self, *exc: object) -> None:
        self._lines.close()

    def begin(self) -> None:
        """The robots drive off."""
        for robot in self._by_name.values():
            robot.begin()

    def duration_s(self) -> float | None:
        """Exploring never ends by itself."""
        return None

    def time_limit_s(self) -> float:
        """Long enough for any two rooms' worth of map to meet; with a few robots the demo ends within a minute."""
        return MERGE_WITHIN_S + MERGE_S_A_ROBOT * max(0, len(self.robots) - FEW_ROBOTS)

    def truth(self) -> OccupancyGrid | None:
        """See `Stage`."""
        return self._world.truth()

    def start_pose(self, robot: str) -> SE2 | None:
        """See `Stage`."""
        return self._by_name[robot].start if robot in self._by_name else None

    def pose_at(self, robot: str, stamp_s: float) -> SE2 | None:
        """See `Stage`."""
        return self._by_name[robot].pose_at(stamp_s) if robot in self._by_name else None


class RecordedStage:
    """A recording cut in n stretches of time, one a robot; none knows where it starts."""

    def __init__(self, path: str, n: int, folder: Path, prefix: str) -> None:
        recording = read_recording(path)
        self._lines = Lines(folder)
        self._replays = [Replay(recording.part(i + 1, n), REPLAY_SPEED) for i in range(n)]
        self.robots = [self._actor(f"{prefix}-{i + 1}", replay) for i, replay in enumerate(self._replays)]

    def _actor(self, name: str, replay: Replay) -> Actor:
        lidar, wheels = self._lines.add(name, SickScanner(ReplayScans(replay)), ReplayBoard(replay))
        settings = (f"wheels.max_speed_mps={REPLAY_V_MAX_MPS}",)
        return Actor(
            name,
            f"sick:{lidar}?baud={SickScanner.baud}&rate={SickScanner.baud}",
            f"wheels:{wheels}?v_max={REPLAY_V_MAX_MPS}",
            settings,
        )

    def __enter__(self) -> RecordedStage:
        self._lines.open()
        return self

    def __exit__(self, *exc: object) -> None:
        self._lines.close()

    def begin(self) -> None:
        """The recordings start, all at the same moment."""
        now_s = time.monotonic()
        for replay in self._replays:
            replay.begin(now_s)

    def duration_s(self) -> float | None:
        """To the last scan of the longest part."""
        return max(replay.duration_s for replay in self._replays)

    def time_limit_s(self) -> float:
        """A while after the last scan."""
        return max(replay.duration_s for replay in self._replays) + SETTLE_S

    def truth(self) -> OccupancyGrid | None:
        """Nobody knows."""
        return None

    def start_pose(self, robot: str) -> SE2 | None:
        """Nobody knows."""
        return None

    def pose_at(self, robot: str, stamp_s: float) -> SE2 | None:
        """Nobody knows."""
        return None


class Lines:
    """The serial lines of a stage: one thread for each robot's pair."""

    def __init__(self, folder: Path, tick_s: float = TICK_S) -> None:
        self._folder, self._tick_s = folder, max(TICK_S, tick_s)
        self._servers: list[PtyServer] = []
        self._stack = contextlib.ExitStack()

    def add(self, name: str, lidar: ByteDevice, wheels: ByteDevice) -> tuple[Path, Path]:
        """Paths of the two ports of one robot."""
        paths = self._folder / f"{name}-lidar", self._folder / f"{name}-wheels"
        self._servers.append(PtyServer([(lidar, paths[0]), (wheels, paths[1])], name, self._tick_s))
        return paths

    def open(self) -> None:
        """Let bytes flow."""
        for server in self._servers:
            self._stack.enter_context(server)

    def close(self) -> None:
        """Unplug everything."""
        self._stack.close()
