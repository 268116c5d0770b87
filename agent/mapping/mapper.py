"""One robot's map: odometry and scans in, a grid and a pose in it out.

    add_scan:  points, motion undone          scan_points.py
               where is the robot now?        tracking.py, every scan
               moved far enough?              then, and only then:
                   all particles              particle_filter.py
                   the grid of the best one   log_odds.py

Readings come in order of time.  The same readings and the same seed give the same map, to the bit.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from agent.mapping.correlation import CoarseField
from agent.mapping.estimate import MapEstimate, MapperStatus, ScanOutcome
from agent.mapping.log_odds import TILE_CELLS, LogOddsGrid
from agent.mapping.motion import Motion, OdometryTrack
from agent.mapping.options import MappingOptions
from agent.mapping.particle_filter import ParticleFilter
from agent.mapping.scan_matching import UNCONSTRAINED_RATIO
from agent.mapping.scan_points import ScanPoints, laser_position_m, scan_points
from agent.mapping.tracking import Tracked, track
from hw.readings import LaserScan, Odometry
from protocol.geometry import SE2, wrap_angle
from protocol.grid import OccupancyGrid

FEWEST_POINTS = 20  # fewer returns than this say nothing about where the robot is
LOST_FRACTION = 0.35  # a scan that fits worse than this is not believed
UNKNOWN_MOTION = (0.5, 0.4)  # one sigma, metres and radians, when odometry says nothing


class Mapper:
    """The map one robot draws."""

    def __init__(self, options: MappingOptions, seed: int) -> None:
        self.options = options
        self.seed = seed
        self.odometry = OdometryTrack(options.max_speed_m_s, options.max_turn_rad_s)
        self.filter = ParticleFilter(options.particles, options.resolution_m, np.random.default_rng(seed))
        self.coarse = CoarseField()
        self.grid = LogOddsGrid(options.resolution_m, options.occupied_above, options.free_below)
        self.epoch = 0
        self.status = MapperStatus.STARTING
        self.pose = np.zeros(3)  # T_map_robot at last_scan_s
        self.last_scan_s = math.nan
        self.keyframe_pose = np.zeros(3)  # the best particle's pose when it last drew
        self.keyframe_s = math.nan
        self.keyframe_deviation = np.zeros(2)  # variances of the motion since then
        self.best = 0  # the particle that is tracked and drawn
        self.scans: list[tuple[float, int, SE2]] = []  # stamp, keyframe, pose relative to that keyframe

    def add_odometry(self, odometry: Odometry) -> None:
        self.odometry.add(odometry)

    def add_scan(self, scan: LaserScan) -> ScanOutcome:
        """Track one scan, and draw it when it is a keyframe."""
        points = scan_points(scan, self.odometry, self.options)
        if len(points.matching_m) < FEWEST_POINTS:
            return self._outcome(MapperStatus.BLIND, False, 0.0, f"only {len(points.matching_m)} returns in a scan")
        if self.status is MapperStatus.STARTING:
            return self._first_scan(points)
        motion = self.odometry.motion_between(self.last_scan_s, points.stamp_s)
        tracked, deviation = self._track(motion, points)
        self.last_scan_s = points.stamp_s
        if tracked.fraction < LOST_FRACTION:
            self.pose = self._predicted(motion)
            return self._outcome(
                MapperStatus.LOST, False, tracked.fraction, f"only {tracked.fraction:.0%} of the scan fits the map"
            )
        self.pose = tracked.pose
        self.keyframe_deviation += np.square(deviation)
        is_keyframe = self._is_keyframe(points.stamp_s)
        if is_keyframe:
            self._update_map(points)
        self._note_pose(points.stamp_s)
        status = MapperStatus.TRACKING if tracked.weakest >= UNCONSTRAINED_RATIO else MapperStatus.UNCONSTRAINED
        return self._outcome(status, is_keyframe, tracked.fraction, "")

    def _first_scan(self, points: ScanPoints) -> ScanOutcome:
        self.filter.start(points.surface_m)
        self._draw(points)
        self.last_scan_s = self.keyframe_s = points.stamp_s
        self._note_pose(points.stamp_s)
        return self._outcome(MapperStatus.TRACKING, True, 1.0, "")

    def _predicted(self, motion: Motion) -> NDArray[np.float64]:
        return as_array(as_pose(self.pose) @ motion.T_from_to)

    def _track(self, motion: Motion, points: ScanPoints) -> tuple[Tracked, tuple[float, float]]:
        """The tracked pose, and one sigma of the motion that led there."""
        step = math.hypot(motion.T_from_to.x_m, motion.T_from_to.y_m), abs(motion.T_from_to.theta_rad)
        deviation = self.options.motion_noise.deviations(motion.T_from_to)
        if not motion.is_known:
            step, deviation = UNKNOWN_MOTION, UNKNOWN_MOTION
        fields = self.filter.fields
        predicted = self._predicted(motion)
        return track(fields, self.best, self.coarse, predicted, step, deviation, points.matching_m), deviation

    def _is_keyframe(self, stamp_s: float) -> bool:
        moved_m = math.hypot(*(self.pose - self.keyframe_pose)[:2])
        turned_rad = abs(wrap_angle(self.pose[2] - self.keyframe_pose[2]))
        return (
            moved_m >= self.options.keyframe_distance_m
            or turned_rad >= self.options.keyframe_angle_rad
            or stamp_s - self.keyframe_s >= self.options.keyframe_interval_s
        )

    def _update_map(self, points: ScanPoints) -> None:
        """Algorithm of particle_filter.py, then the grid of the best particle."""
        motion = as_array(as_pose(self.keyframe_pose).inverse() @ as_pose(self.pose))
        deviation_m, deviation_rad = np.sqrt(self.keyframe_deviation)
        self.filter.update(motion, (float(deviation_m), float(deviation_rad)), points.matching_m, points.surface_m)
        self.best = self.filter.best()
        self.pose = self.filter.poses[self.best].copy()
        self.keyframe_s = points.stamp_s
        self._draw(points)

    def _draw(self, points: ScanPoints) -> None:
        """The scan into the grid and the coarse field, from where the best particle stands."""
        T_map_robot = as_pose(self.pose)
        self.keyframe_pose, self.keyframe_deviation = self.pose.copy(), np.zeros(2)
        laser_m = laser_position_m(self.options, T_map_robot)
        self.grid.add(laser_m, T_map_robot.apply(points.points_m), points.is_hit, clears=not points.is_partial)
        self.coarse.stamp(T_map_robot.apply(points.matching_m).astype(np.float32))

    def _note_pose(self, stamp_s: float) -> None:
        relative = as_pose(self.keyframe_pose).inverse() @ as_pose(self.pose)
        self.scans.append((stamp_s, len(self.filter.path) - 1, relative))

    def trajectory(self) -> NDArray[np.float64]:
        """(N, 4) stamp, x, y, theta of the robot at every tracked scan, as the best particle remembers it now."""
        keyframes = self.filter.path_of(self.best)
        poses = [(stamp_s, as_pose(keyframes[k]) @ relative) for stamp_s, k, relative in self.scans]
        return np.array([[stamp_s, pose.x_m, pose.y_m, pose.theta_rad] for stamp_s, pose in poses]).reshape(-1, 4)

    def _outcome(self, status: MapperStatus, is_keyframe: bool, fraction: float, reason: str) -> ScanOutcome:
        if self.status is not MapperStatus.STARTING or is_keyframe:
            self.status = status
        return ScanOutcome(status, as_pose(self.pose), is_keyframe, fraction, reason)

    def estimate(self) -> MapEstimate:
        """The map and the pose as they are now; the grid is a copy."""
        T_map_robot = as_pose(self.pose)
        T_odom_robot = None if math.isnan(self.last_scan_s) else self.odometry.pose_at(self.last_scan_s)
        is_empty = self.grid.revision == 0
        return MapEstimate(
            grid=OccupancyGrid.empty(self.options.resolution_m) if is_empty else self.grid.trinary(),
            T_map_robot=T_map_robot,
            revision=self.grid.revision,
            epoch=self.epoch,
            effective_particles=self.filter.effective_particles(),
            status=self.status,
            T_map_odom=T_map_robot if T_odom_robot is None else T_map_robot @ T_odom_robot.inverse(),
            stamp_s=self.last_scan_s,
            tile_cells=TILE_CELLS,
            first_tile=(int(self.grid.first_tile[0]), int(self.grid.first_tile[1])),
            tile_revisions=self.grid.tile_revisions.copy(),
        )


def as_pose(xyt: NDArray[np.float64]) -> SE2:
    return SE2(float(xyt[0]), float(xyt[1]), wrap_angle(float(xyt[2])))


def as_array(pose: SE2) -> NDArray[np.float64]:
    return np.array([pose.x_m, pose.y_m, pose.theta_rad])
