"""The grid that belongs to one particle's path, kept right when the filter changes its mind.

The filter knows every particle's path; the grid is drawn for one.  When that particle turns out to remember another past
than the one on the grid, the grid is drawn again from the kept scans, a few per call, and swapped in when done.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent.mapping.correlation import CoarseField
from agent.mapping.log_odds import LogOddsGrid
from agent.mapping.options import MappingOptions
from agent.mapping.scan_points import ScanPoints, laser_position_m
from protocol.geometry import SE2

REDRAW_M = 0.05  # a past that moved by a cell is drawn again; less is left to the next time
REDRAW_RAD = 0.01
SCANS_A_CALL = 20  # about 10 ms at 360 beams
KEPT_SCANS = 20_000  # 4 hours of driving, 40 to 80 MB; older scans stay on the grid as they were last drawn

Poses = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class DrawnScan:
    """What drawing a keyframe again needs."""

    points_m: NDArray[np.float32]  # (N, 2) ray ends, robot frame
    is_hit: NDArray[np.bool_]  # (N,)
    is_partial: bool


class Drawing:
    """Grid and coarse field of the drawn path; `poses[k]` is where keyframe k was drawn from."""

    def __init__(self, options: MappingOptions) -> None:
        self.options = options
        self.grid = new_grid(options)
        self.coarse = CoarseField()
        self.scans: list[DrawnScan] = []
        self.poses: Poses = np.empty((0, 3))
        self.oldest = 0  # keyframe number of scans[0]
        self.base = new_grid(options)  # keyframes before `oldest`, drawn for good
        self.fresh: Drawing | None = None  # a drawing in progress, of the first len(fresh.poses) keyframes
        self.target: Poses = np.empty((0, 3))  # where its keyframes are drawn from
        self.redrawn = 0  # times it was swapped in

    def add(self, points: ScanPoints, pose: NDArray[np.float64]) -> None:
        """A new keyframe."""
        scan = DrawnScan(points.points_m, points.is_hit, points.is_partial)
        self.scans.append(scan)
        self._draw(scan, pose)

    def _draw(self, scan: DrawnScan, pose: NDArray[np.float64]) -> None:
        draw(self.grid, self.options, scan, pose)
        ends = SE2(float(pose[0]), float(pose[1]), float(pose[2])).apply(scan.points_m[scan.is_hit])
        if len(ends):
            self.coarse.stamp(ends.astype(np.float32))
        self.poses = np.vstack([self.poses, pose])

    def follow(self, path: Poses) -> None:
        """Draw a few scans of what has to be drawn again so that the grid shows `path`, (K, 3) poses of all keyframes."""
        path = path[self.oldest :]
        if self.fresh is None and differ(path, self.poses):
            self.fresh, self.target = self._blank(), path
        if self.fresh is not None:
            self._continue(self.fresh, path)
        self._forget_oldest()

    def resume(self, target: Poses, done: int) -> None:
        """Go on with a drawing of which `done` keyframes were drawn."""
        self.fresh, self.target = self._blank(), target
        for k in range(done):
            self.fresh._draw(self.scans[k], target[k])

    def _blank(self) -> Drawing:
        fresh = Drawing(self.options)
        fresh.grid = self.base.copy()
        return fresh

    def _continue(self, fresh: Drawing, path: Poses) -> None:
        done = len(fresh.poses)
        self.target = np.vstack([self.target, path[len(self.target) :]])
        for k in range(done, min(done + SCANS_A_CALL, len(path))):
            fresh._draw(self.scans[k], self.target[k])
        if len(fresh.poses) == len(path):
            self.grid.replace_by(fresh.grid)
            self.coarse, self.poses = fresh.coarse, fresh.poses
            self.fresh, self.target = None, np.empty((0, 3))
            self.redrawn += 1

    def _forget_oldest(self) -> None:
        """Beyond KEPT_SCANS the older half becomes part of the base."""
        if len(self.scans) <= KEPT_SCANS or self.fresh is not None:
            return
        half = len(self.scans) // 2
        for scan, pose in zip(self.scans[:half], self.poses[:half], strict=True):
            draw(self.base, self.options, scan, pose)
        del self.scans[:half]
        self.poses = self.poses[half:]
        self.oldest += half


def new_grid(options: MappingOptions) -> LogOddsGrid:
    return LogOddsGrid(options.resolution_m, options.occupied_above, options.free_below)


def draw(grid: LogOddsGrid, options: MappingOptions, scan: DrawnScan, pose: NDArray[np.float64]) -> None:
    """One keyframe on a grid."""
    T_map_robot = SE2(float(pose[0]), float(pose[1]), float(pose[2]))
    laser_m = laser_position_m(options, T_map_robot)
    grid.add(laser_m, T_map_robot.apply(scan.points_m), scan.is_hit, clears=not scan.is_partial)


def differ(a: Poses, b: Poses) -> bool:
    """Whether two paths are apart by more than is left alone."""
    if len(a) == 0:
        return False
    d = np.abs(a - b)
    return bool(max(d[:, 0].max(), d[:, 1].max()) > REDRAW_M or d[:, 2].max() > REDRAW_RAD)
