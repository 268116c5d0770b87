"""What the mapper answers: a map with a pose in it, and what became of each scan."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from agent.mapping.loop_closure import LoopClosed
from agent.mapping.wheel_check import WheelFigures
from protocol.geometry import SE2
from protocol.grid import OccupancyGrid


class MapperStatus(Enum):
    """How it goes."""

    STARTING = "starting"  # no scan yet
    TRACKING = "tracking"  # the scans fit the map
    UNCONSTRAINED = "unconstrained"  # they fit, but slide along one direction: odometry holds it (a corridor)
    LOST = "lost"  # they do not fit: nothing is drawn until they do again
    STUCK = "stuck"  # the LIDAR repeats itself: nothing is drawn
    BLIND = "blind"  # too few returns to say anything


@dataclass(frozen=True, slots=True, eq=False)
class ScanOutcome:
    """What became of one scan."""

    status: MapperStatus
    T_map_robot: SE2
    is_keyframe: bool  # it entered the map
    fraction: float  # how much of it lies on mapped walls, 0 to 1
    reason: str = ""  # one sentence when something is not as it should be
    loop: LoopClosed | None = None  # the map was bent until the path met itself: the pose is on the new map already


@dataclass(frozen=True, slots=True, eq=False)
class MapEstimate:
    """The map so far and the robot in it."""

    grid: OccupancyGrid
    T_map_robot: SE2  # at `stamp_s`
    revision: int  # grows whenever a cell may have changed
    epoch: int  # grows when a new local map was started: another frame, revisions start again
    effective_particles: float
    status: MapperStatus
    T_map_odom: SE2  # T_map_odom @ (newest odometry) is where the robot is now
    stamp_s: float
    tile_cells: int  # side of a change tile
    first_tile: tuple[int, int]  # (row, col) of the tile at the grid's corner, in tiles from the map's origin
    tile_revisions: NDArray[np.int64]  # (rows, cols) revision that last changed each tile
    loops_closed: int = 0  # times the map was bent, in all epochs
    wheels: WheelFigures | None = None  # what the wheels tell against what the scans show; None until it is known
    usual_fraction: float = 1.0  # how much of the last hundred scans lay on mapped walls, 0 to 1

    def changed_tiles(self, since_revision: int) -> list[tuple[int, int]]:
        """(row, col) of tiles changed after a revision, counted from the map's origin: they keep their names as it grows."""
        rows, cols = np.nonzero(self.tile_revisions > since_revision)
        return [(int(r) + self.first_tile[0], int(c) + self.first_tile[1]) for r, c in zip(rows, cols, strict=True)]
