"""One robot's map: odometry and scans in, a grid and a pose in it out.

    add_scan:  points, motion undone              scan_points.py
               where is the robot now?            local_map.py, every scan
               does what it sees contradict?      then nothing is drawn; carried away?  relocalization.py
               moved far enough?                  then, and only then, the map is updated
               back where it once was?            then the path is bent until it meets itself   loop_closure.py

A robot that finds itself nowhere on its map begins a new one, in a new frame, with the next epoch.  Readings come in order
of time.  The same readings and the same seed give the same map, to the bit.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from agent.mapping import checkpoint
from agent.mapping.estimate import MapEstimate, MapperStatus, ScanOutcome
from agent.mapping.local_map import LocalMap, as_pose
from agent.mapping.log_odds import TILE_CELLS
from agent.mapping.loop_closure import FitMaps
from agent.mapping.motion import Motion, OdometryTrack
from agent.mapping.options import MappingOptions
from agent.mapping.relocalization import Relocalization
from agent.mapping.scan_matching import UNCONSTRAINED_RATIO
from agent.mapping.scan_points import ScanPoints, laser_position_m, reference_stamp_s, scan_points
from agent.mapping.tracking import GOOD_FRACTION, SURE_FRACTION, Tracked
from agent.mapping.wheel_check import WheelCheck
from hw.readings import LaserScan, Odometry
from protocol.geometry import wrap_angle
from protocol.grid import OccupancyGrid

FEWEST_POINTS = 20  # fewer returns than this say nothing about where the robot is
UNEXPLAINED = 0.1  # field value: 13 cm from the nearest wall
CONTRADICTED = 0.35  # share of a scan that the map rules out; a crowd of people stays below
LOST_AFTER = 5  # scans in a row that contradict the map before the robot looks for itself elsewhere
CONFIRMED_AFTER = 5  # scans in a row that fit, after it found itself, before it draws again
NEW_MAP_AFTER_S = 10.0  # of looking everywhere in vain
USUAL_OVER = 100  # scans
SKEWED_RAD = math.radians(3.0)  # of a revolution: a wheel spun, and the scan is a spiral; it is followed, not drawn
STUCK_AFTER = 3  # identical scans in a row, while the wheels turn
STUCK_MOVED_M = 0.05
STUCK_TURNED_RAD = 0.05
NO_WHEELS = (
    "no odometry, and the scans are too far apart to follow without: connect the wheels, or drive slower; nothing is drawn"
)


class Mapper:
    """The map one robot draws; `fit` is asked when it seems to be back where it was, without it no loop is closed afterwards."""

    def __init__(self, options: MappingOptions, seed: int, fit: FitMaps | None = None) -> None:
        self.options = options
        self.rng = np.random.default_rng(seed)
        self.odometry = OdometryTrack(options.max_speed_m_s, options.max_turn_rad_s)
        self.wheels = WheelCheck()
        self.usual_fraction = 1.0  # of a scan that lies on mapped walls
        self.fit = fit
        self.map = LocalMap(options, self.rng, fit)
        self.epoch = 0
        self.loops_closed = 0
        self.status = MapperStatus.STARTING
        self.contradictions = 0  # scans in a row
        self.confirmations_missing = 0  # scans that must fit before drawing goes on
        self.lost_since_s = math.nan
        self.search: Relocalization | None = None
        self.last_ranges = np.zeros(0, np.float32)
        self.repeats = 0  # scans in a row that equal last_ranges
        self.repeats_since_s = math.nan

    def add_odometry(self, odometry: Odometry) -> None:
        """Samples in order of time; a clock that starts again is a new beginning of the odometry."""
        self.odometry.add(odometry)

    def add_scan(self, scan: LaserScan) -> ScanOutcome:
        """Track one scan, and draw it when it is a keyframe."""
        points = scan_points(scan, self.odometry, self.options)
        is_stuck = self._is_stuck(scan)
        if is_stuck and points.n > 0:  # scans of a place too wide to see anything are alike, too
            return self._held(
                points, MapperStatus.STUCK, 0.0, "the LIDAR repeats one scan while the wheels turn: unplug and replug it"
            )
        if len(points.matching_m) < FEWEST_POINTS:
            return self._held(
                points, MapperStatus.BLIND, 0.0, f"only {len(points.matching_m)} of {len(scan.ranges_m)} beams returned"
            )
        if self.map.is_empty:
            self.map.start(points)
            return self._outcome(MapperStatus.TRACKING, True, 1.0)
        if self.search is not None or not math.isnan(self.lost_since_s):
            return self._look_everywhere(points)
        return self._follow(points)

    def _follow(self, points: ScanPoints) -> ScanOutcome:
        """The ordinary case: the robot is near where its wheels say."""
        motion = self._motion(points)
        tracked = self.map.track(motion, points)
        if not self._is_believable(points, tracked):
            return self._contradicted(points, tracked)
        self.contradictions = 0
        self.usual_fraction += (tracked.fraction - self.usual_fraction) / USUAL_OVER
        tracked, twist_rad = self.map.untwist(motion, points, tracked)
        skew_rad = self._skew_rad(points, motion, tracked)
        self._check_wheels(motion, tracked, skew_rad)
        self.map.note_motion(motion)
        self.confirmations_missing = max(self.confirmations_missing - 1, int(skew_rad > SKEWED_RAD))
        is_keyframe = self.confirmations_missing == 0 and self.map.is_keyframe(points.stamp_s, tracked.pose)
        if is_keyframe:
            self.map.update(points.untwisted(twist_rad), tracked.pose)
        self.map.accept(points.stamp_s, self.map.keyframe_pose.copy() if is_keyframe else tracked.pose)
        loop = self.map.redraw() if is_keyframe or self.map.drawing.is_bending else None
        self.loops_closed += loop is not None
        is_open = tracked.weakest < UNCONSTRAINED_RATIO
        status = MapperStatus.UNCONSTRAINED if is_open else MapperStatus.TRACKING
        reason = f"the wheels slip: this scan is twisted by {math.degrees(skew_rad):.0f} degrees" if skew_rad > SKEWED_RAD else ""
        return replace(self._outcome(status, is_keyframe, tracked.fraction, reason), loop=loop)

    def _skew_rad(self, points: ScanPoints, motion: Motion, tracked: Tracked) -> float:
        """How far the last beam of a revolution is turned against the first: the wheels, by which its motion was undone, turned
        otherwise than the robot."""
        seconds = points.stamp_s - self.map.last_scan_s
        if not motion.is_known or seconds <= 0.0:
            return 0.0
        slipped_rad = abs(wrap_angle(float(tracked.pose[2] - self.map.predicted(motion)[2])))
        return slipped_rad * min(points.revolution_s / seconds, 1.0)

    def _check_wheels(self, motion: Motion, tracked: Tracked, skew_rad: float) -> None:
        """What matching adds to a step of the wheels; a step that jumps or slips is no measure of them."""
        if not motion.is_known or tracked.is_jump or skew_rad > SKEWED_RAD:
            self.wheels.break_off()
            return
        added = as_pose(self.map.predicted(motion)).inverse() @ as_pose(tracked.pose)
        self.wheels.add(motion.T_from_to, added, is_open=tracked.weakest < UNCONSTRAINED_RATIO)

    def _is_believable(self, points: ScanPoints, tracked: Tracked) -> bool:
        """A good fit where the robot can be, a very good one where its wheels say it cannot (they slip, but a LIDAR that tilts
        over a door sill fits anywhere); a poor one when wheels vouch for it and the map does not rule the scan out."""
        if tracked.is_jump and self.contradictions < LOST_AFTER - 1:
            return tracked.fraction >= SURE_FRACTION
        if tracked.fraction >= GOOD_FRACTION:
            return True
        return bool(self.odometry.stamps_s) and self._contradiction(points, tracked) <= CONTRADICTED

    def _motion(self, points: ScanPoints) -> Motion:
        """Since the last accepted scan: by the wheels, or as before when there are no wheels."""
        if self.odometry.stamps_s:
            return self.odometry.motion_between(self.map.last_scan_s, points.stamp_s)
        return self.map.steady_motion(points.stamp_s)

    def _contradiction(self, points: ScanPoints, tracked: Tracked) -> float:
        """Share of the scan that cannot be so: ends in space known to be free, or behind a wall.  New rooms can."""
        T_map_robot = as_pose(tracked.pose)
        grid, ends_m = self.map.drawing.grid, T_map_robot.apply(points.matching_m)
        cannot = grid.is_free(ends_m) | grid.is_behind_wall(laser_position_m(self.options, T_map_robot), ends_m)
        return float(np.mean(cannot & (tracked.likelihood < UNEXPLAINED)))

    def _contradicted(self, points: ScanPoints, tracked: Tracked) -> ScanOutcome:
        self.contradictions += 1
        if self.contradictions >= LOST_AFTER:
            self.contradictions = 0
            self.lost_since_s = points.stamp_s
        reason = f"only {tracked.fraction:.0%} of the scan fits the map" if self.odometry.stamps_s else NO_WHEELS
        return self._held(points, MapperStatus.LOST, tracked.fraction, reason)

    def _look_everywhere(self, points: ScanPoints) -> ScanOutcome:
        """Lost: back where the wheels say, or a few headings of the search per scan; found, or after a while a new map."""
        motion = self._motion(points)
        tracked = self.map.track(motion, points)
        if tracked.fraction >= GOOD_FRACTION:
            return self._found(points)
        if self.search is None:
            self.search = self.map.search_for(points.surfels, points.stamp_s)
        self.search.step()
        if self.search.is_done:
            found = self.search.answer(self.map.filter.fields, self.map.filter.followed)
            if found is not None:
                self.map.move_to(found, self.search.stamp_s)
                return self._found(points)
            self.search = None
            if motion.is_known and not tracked.is_jump and self._contradiction(points, tracked) <= CONTRADICTED:
                return self._found(points)  # nowhere else, and nothing speaks against the wheels: it drove on into the unknown
            if points.stamp_s - self.lost_since_s > NEW_MAP_AFTER_S:
                return self._begin_anew(points)
        reason = "lost: looking for this place on the whole map; nothing is drawn" if self.odometry.stamps_s else NO_WHEELS
        return self._held(points, MapperStatus.LOST, 0.0, reason)

    def _found(self, points: ScanPoints) -> ScanOutcome:
        """Go on from where the map now says the robot was, drawing nothing until a few scans agree."""
        self.search, self.lost_since_s = None, math.nan
        self.confirmations_missing = CONFIRMED_AFTER
        return self._follow(points)

    def _begin_anew(self, points: ScanPoints) -> ScanOutcome:
        self.epoch += 1
        self.map = LocalMap(self.options, self.rng, self.fit)
        self.lost_since_s = math.nan
        self.map.start(points)
        return self._outcome(
            MapperStatus.TRACKING, True, 1.0, f"this place is not on the map: a new local map begins, epoch {self.epoch}"
        )

    def _is_stuck(self, scan: LaserScan) -> bool:
        """The same numbers again and again, though the wheels turn."""
        if not np.array_equal(scan.ranges_m, self.last_ranges, equal_nan=True):
            self.last_ranges, self.repeats, self.repeats_since_s = scan.ranges_m, 0, reference_stamp_s(scan)
            return False
        self.repeats += 1
        if self.repeats < STUCK_AFTER:
            return False
        motion = self.odometry.motion_between(self.repeats_since_s, reference_stamp_s(scan)).T_from_to
        return math.hypot(motion.x_m, motion.y_m) > STUCK_MOVED_M or abs(motion.theta_rad) > STUCK_TURNED_RAD

    def _held(self, points: ScanPoints, status: MapperStatus, fraction: float, reason: str) -> ScanOutcome:
        """A scan that is not believed: the pose is what the wheels say, and nothing is drawn."""
        if self.map.is_empty:
            return ScanOutcome(status, as_pose(self.map.pose), False, fraction, reason)
        self.status = status
        return ScanOutcome(status, as_pose(self.map.predicted(self._motion(points))), False, fraction, reason)

    def _outcome(self, status: MapperStatus, is_keyframe: bool, fraction: float, reason: str = "") -> ScanOutcome:
        self.status = status
        return ScanOutcome(status, as_pose(self.map.pose), is_keyframe, fraction, reason)

    def finish(self) -> None:
        """No scan will come any more: a loop that was just found is drawn to the end."""
        while self.map.drawing.is_bending:
            self.loops_closed += self.map.redraw() is not None

    def estimate(self) -> MapEstimate:
        """The map and the pose as they are now; the grid is a copy."""
        grid, stamp_s = self.map.drawing.grid, self.map.last_scan_s
        T_map_robot = as_pose(self.map.pose)
        T_odom_robot = None if self.map.is_empty else self.odometry.pose_at(stamp_s)
        return MapEstimate(
            grid=OccupancyGrid.empty(self.options.resolution_m) if self.map.is_empty else grid.trinary(),
            T_map_robot=T_map_robot,
            revision=grid.revision,
            epoch=self.epoch,
            effective_particles=self.map.filter.effective_particles(),
            status=self.status,
            T_map_odom=T_map_robot if T_odom_robot is None else T_map_robot @ T_odom_robot.inverse(),
            stamp_s=stamp_s,
            tile_cells=TILE_CELLS,
            first_tile=(int(grid.first_tile[0]), int(grid.first_tile[1])),
            tile_revisions=grid.tile_revisions.copy(),
            loops_closed=self.loops_closed,
            wheels=self.wheels.figures(),
            usual_fraction=self.usual_fraction,
        )

    def checkpoint(self) -> bytes:
        """Everything the future depends on: a restored mapper goes on to the identical map."""
        return checkpoint.pack(self)

    @staticmethod
    def restore(data: bytes, options: MappingOptions, fit: FitMaps | None = None) -> Mapper:
        """The mapper of `checkpoint`; raises `CheckpointError` when the bytes or the options do not fit."""
        mapper = Mapper(options, 0, fit)
        checkpoint.unpack(data, mapper)
        return mapper
