"""The grid that belongs to one particle's path, kept right when the filter changes its mind.

The filter knows every particle's path; the grid is drawn for one.  When that particle turns out to remember another past
than the one on the grid, the grid is drawn again from the kept scans, a few per call, and swapped in when done.  A closed
loop bends the path of all particles: then their field is stamped again, too.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from agent.mapping.correlation import CoarseField
from agent.mapping.kept_scans import FEWEST_TO_THIN, NEVER_THINNED, THIN_AGAIN, KeptScan, needless
from agent.mapping.likelihood import TiledFields
from agent.mapping.log_odds import LogOddsGrid
from agent.mapping.options import MappingOptions
from agent.mapping.particle_filter import FIELD_SIGMA_M, composed, inverted
from agent.mapping.scan_matching import Poses, placed
from agent.mapping.scan_points import ScanPoints, laser_position_m, surface_points
from protocol.geometry import SE2
from protocol.grid import OCCUPIED

REDRAW_M = 0.05  # a past that moved by a cell is drawn again; less is left to the next time
REDRAW_RAD = 0.01
SCANS_A_CALL = 20  # about 10 ms at 360 beams
BENT_SCANS_A_CALL = 40  # a bent map is wanted soon
KEPT_BYTES = 16_000_000  # of scans: 10,000 places at 360 beams; beyond, the older half stays as it was last drawn


class Drawing:
    """Grid and coarse field of the drawn path; `poses[k]` is where keyframe oldest + k was drawn from."""

    def __init__(self, options: MappingOptions) -> None:
        self.options = options
        self.grid = new_grid(options)
        self.coarse = CoarseField()
        self.scans: dict[int, KeptScan] = {}  # by keyframe, in order
        self.poses: Poses = np.empty((0, 3))
        self.oldest = 0  # keyframe that can be drawn again
        self.thin_at = FEWEST_TO_THIN  # scans kept
        self.base = new_grid(options)  # keyframes before `oldest`, drawn for good
        self.fresh: Drawing | None = None  # a drawing in progress, of the first len(fresh.poses) keyframes
        self.target: Poses = np.empty((0, 3))  # where its keyframes are drawn from
        self.redrawn = 0  # times it was swapped in
        self.field: TiledFields | None = None  # of a bent drawing: what every particle is going to see
        self.correction: Poses = np.zeros((1, 3))  # what a bending does to keyframes that come while it is drawn

    @property
    def is_bending(self) -> bool:
        return self.fresh is not None and self.fresh.field is not None

    def add(self, points: ScanPoints, pose: NDArray[np.float64]) -> None:
        """A new keyframe."""
        scan = KeptScan.of(points)
        self.scans[self.oldest + len(self.poses)] = scan
        self._draw(scan, pose)

    def _draw(self, scan: KeptScan | None, pose: NDArray[np.float64]) -> None:
        self.poses = np.vstack([self.poses, pose])
        if scan is None:
            return
        draw(self.grid, self.options, scan, pose)
        ends = SE2(float(pose[0]), float(pose[1]), float(pose[2])).apply(scan.points_m[scan.is_hit])
        if len(ends):
            self.coarse.stamp(ends.astype(np.float32))
        if self.field is not None and len(ends):
            stamp_surface(self.field, self.options, scan, pose)

    def follow(self, path: Poses) -> TiledFields | None:
        """Draw a few scans of what has to be drawn again so that the grid shows `path`, (K, 3) poses of all keyframes.

        When a bent drawing is done, it is the map, `poses` is the path, and the answer is the field that goes with it.
        """
        path, field = path[self.oldest :], None
        if self.fresh is None and differ(path, self.poses):
            self.fresh, self.target = self._blank(), path
        if self.fresh is not None:
            field = self._continue(self.fresh, path)
        if self.fresh is None:
            self._forget()
        return field

    def bend(self, bent: Poses, path: Poses) -> None:
        """Begin to draw everything along another path than `path`: a loop was closed."""
        self.correction = composed(bent[-1:], inverted(path[-1:]))
        self.resume(bent[self.oldest :], 0, is_bent=True)

    def resume(self, target: Poses, done: int, is_bent: bool) -> None:
        """Go on with a drawing of which `done` keyframes were drawn."""
        self.fresh, self.target = self._blank(), target
        if is_bent:
            self.fresh.field = TiledFields(1, self.options.resolution_m, FIELD_SIGMA_M)
            stamp_all(self.fresh.field, self._base_points_m())
        for k in range(done):
            self.fresh._draw(self.scans.get(self.oldest + k), target[k])

    def _blank(self) -> Drawing:
        fresh = Drawing(self.options)
        fresh.grid = self.base.copy()
        if len(points_m := self._base_points_m()):
            fresh.coarse.stamp(points_m)
        return fresh

    def _base_points_m(self) -> NDArray[np.float32]:
        """(N, 2) middles of the occupied cells that no kept scan can draw again."""
        grid = self.base.trinary()
        return grid.points_of(np.argwhere(grid.cells == OCCUPIED)).astype(np.float32)

    def _continue(self, fresh: Drawing, path: Poses) -> TiledFields | None:
        done, added = len(fresh.poses), path[len(self.target) :]
        if fresh.field is not None:
            added = composed(np.repeat(self.correction, len(added), axis=0), added)
        self.target = np.vstack([self.target, added])
        most = SCANS_A_CALL if fresh.field is None else BENT_SCANS_A_CALL
        for k in range(done, min(done + most, len(path))):
            fresh._draw(self.scans.get(self.oldest + k), self.target[k])
        if len(fresh.poses) < len(path):
            return None
        self.grid.replace_by(fresh.grid)
        self.coarse, self.poses = fresh.coarse, fresh.poses
        self.fresh, self.target = None, np.empty((0, 3))
        self.redrawn += 1
        return fresh.field

    def _forget(self) -> None:
        """A few scans a place are kept; where that is more than KEPT_BYTES, the older half becomes part of the base."""
        if len(self.scans) < self.thin_at:
            return
        kept = np.array(list(self.scans))
        kept = kept[kept < self.oldest + len(self.poses) - NEVER_THINNED]
        is_all_round = np.array([self.scans[k].is_all_round for k in kept.tolist()], bool)
        for k in kept[needless(self.poses[kept - self.oldest], is_all_round)].tolist():
            del self.scans[k]
        if sum(scan.nbytes for scan in self.scans.values()) > KEPT_BYTES:
            self._draw_for_good()
        self.thin_at = max(FEWEST_TO_THIN, int(THIN_AGAIN * len(self.scans)))

    def _draw_for_good(self) -> None:
        """The older half of what is kept becomes part of the base."""
        kept = list(self.scans)
        half = len(kept) // 2
        for k in kept[:half]:
            draw(self.base, self.options, self.scans.pop(k), self.poses[k - self.oldest])
        self.poses = self.poses[kept[half] - self.oldest :]
        self.oldest = kept[half]


def stamp_surface(field: TiledFields, options: MappingOptions, scan: KeptScan, pose: NDArray[np.float64]) -> None:
    """What one keyframe adds to the field of a particle."""
    laser = np.array(laser_position_m(options, SE2.identity()))
    points_m = scan.points_m
    ranges_m = np.hypot(*(points_m - laser).T).astype(np.float64)
    x, y, _, _ = placed(pose[None], surface_points(points_m, scan.is_hit, ranges_m))
    stamp_all(field, np.stack([x[0], y[0]], axis=1))


def stamp_all(field: TiledFields, points_m: NDArray[np.float32]) -> None:
    """Draw (N, 2) map-frame points into the field of the only particle."""
    if len(points_m):
        field.cover(points_m.min(axis=0).astype(np.float64), points_m.max(axis=0).astype(np.float64))
        field.stamp(points_m[None, :, 0], points_m[None, :, 1])


def new_grid(options: MappingOptions) -> LogOddsGrid:
    return LogOddsGrid(options.resolution_m, options.occupied_above, options.free_below)


def draw(grid: LogOddsGrid, options: MappingOptions, scan: KeptScan, pose: NDArray[np.float64]) -> None:
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
