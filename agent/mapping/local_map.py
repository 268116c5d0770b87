"""One map in one frame: the particles, the grid of the followed one, and where the robot is in it.

track     every scan       where is the robot?                        tracking.py
update    a keyframe       all particles; the grid of the followed    particle_filter.py, redrawing.py
                           has a loop been missed?                    loop_closure.py
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from agent.mapping.forgetting import forget_keyframes
from agent.mapping.loop_closure import FitMaps, LoopClosed, LoopCloser
from agent.mapping.motion import Motion
from agent.mapping.options import MappingOptions
from agent.mapping.particle_filter import ParticleFilter, composed
from agent.mapping.path_graph import apart
from agent.mapping.redrawing import Drawing
from agent.mapping.relocalization import Relocalization
from agent.mapping.scan_matching import information
from agent.mapping.scan_points import ScanPoints
from agent.mapping.tracking import Tracked, track
from agent.mapping.trajectory import Trajectory
from agent.mapping.twist import STANDING_M, TwistMeans, refine_twisted, way_m
from protocol.geometry import SE2, wrap_angle

UNKNOWN_MOTION = (0.5, 0.4)  # one sigma, metres and radians, when odometry says nothing


class LocalMap:
    """What one robot knows since it last began anew."""

    def __init__(self, options: MappingOptions, rng: np.random.Generator, fit: FitMaps | None = None) -> None:
        self.options = options
        self.filter = ParticleFilter(options.particles, options.resolution_m, rng)
        self.drawing = Drawing(options)
        self.loops = LoopCloser(fit)
        self.pose = np.zeros(3)  # T_map_robot at last_scan_s
        self.last_scan_s = math.nan
        self.keyframe_pose = np.zeros(3)  # the followed particle's pose when it last drew
        self.keyframe_s = math.nan
        self.keyframe_variance = np.zeros(2)  # of the motion since then
        self.scans = Trajectory()
        self.twists = TwistMeans()

    @property
    def is_empty(self) -> bool:
        return math.isnan(self.last_scan_s)

    def start(self, points: ScanPoints) -> None:
        """The first scan makes the frame: the robot stands at its origin."""
        self.filter.start(points.surface_m)
        self.drawing.add(points, self.pose)
        self.keyframe_s = points.stamp_s
        self.accept(points.stamp_s, self.pose)

    def track(self, motion: Motion, points: ScanPoints) -> Tracked:
        """Where the robot is now, if it moved like this; believed or not by the caller."""
        step = math.hypot(motion.T_from_to.x_m, motion.T_from_to.y_m), abs(motion.T_from_to.theta_rad)
        deviation = self.options.motion_noise.deviations(motion.T_from_to)
        if not motion.is_known:
            step = deviation = UNKNOWN_MOTION
        predicted = self.predicted(motion)
        fields, particle = self.filter.fields, self.filter.followed
        return track(fields, particle, self.drawing.coarse, predicted, step, deviation, points.surfels)

    def untwist(self, motion: Motion, points: ScanPoints, tracked: Tracked) -> tuple[Tracked, float]:
        """The same scan, matched once more together with its twist: how far the robot turned meanwhile beyond its wheels."""
        share = min(points.revolution_s / max(points.stamp_s - self.last_scan_s, 1e-3), 1.0)
        if not motion.is_known or not points.surfel_turns.any() or way_m(motion.T_from_to) * share < STANDING_M:
            return tracked, 0.0
        predicted, weights = self.predicted(motion), information(*self.options.motion_noise.deviations(motion.T_from_to))
        fields, particle = self.filter.fields, self.filter.followed
        pose, twist_rad = refine_twisted(fields, particle, tracked.pose, predicted, weights, points.surfels, points.surfel_turns)
        turned_rad = wrap_angle(float(pose[2] - predicted[2])) * share
        return replace(tracked, pose=pose), self.twists.corrected(twist_rad, turned_rad)

    def predicted(self, motion: Motion) -> NDArray[np.float64]:
        return as_array(as_pose(self.pose) @ motion.T_from_to)

    def accept(self, stamp_s: float, pose: NDArray[np.float64]) -> None:
        """The robot is here now."""
        self.pose, self.last_scan_s = pose, stamp_s
        relative = as_pose(self.keyframe_pose).inverse() @ as_pose(pose)
        self.scans.add(stamp_s, len(self.filter.line) - 1, relative)

    def note_motion(self, motion: Motion) -> None:
        """Uncertainty grows with what the wheels say."""
        deviation = self.options.motion_noise.deviations(motion.T_from_to) if motion.is_known else UNKNOWN_MOTION
        self.keyframe_variance = self.keyframe_variance + np.square(deviation)

    def steady_motion(self, stamp_s: float) -> Motion:
        """Without wheels: as fast as between the last two scans."""
        if len(self.scans) < 2:
            return Motion(SE2.identity(), is_known=False)
        two = self.scans.rows[-2:].tolist()
        (before_s, *_), (last_s, *_) = two
        before, last = (as_pose(self.filter.line[k]) @ SE2(*map(float, relative)) for _, k, relative in two)
        step = before.inverse() @ last
        share = (stamp_s - last_s) / max(last_s - before_s, 1e-3)
        if share > 3.0:
            return Motion(SE2.identity(), is_known=False)
        return Motion(SE2(step.x_m * share, step.y_m * share, step.theta_rad * share), is_known=False)

    def is_keyframe(self, stamp_s: float, pose: NDArray[np.float64]) -> bool:
        """Moved or turned far enough, or long enough ago."""
        return bool(
            math.hypot(*(pose - self.keyframe_pose)[:2]) >= self.options.keyframe_distance_m
            or abs(wrap_angle(pose[2] - self.keyframe_pose[2])) >= self.options.keyframe_angle_rad
            or stamp_s - self.keyframe_s >= self.options.keyframe_interval_s
        )

    def update(self, points: ScanPoints, pose: NDArray[np.float64]) -> None:
        """A keyframe seen from `pose`: every particle matches and draws it, and so does the grid."""
        motion = as_array(as_pose(self.keyframe_pose).inverse() @ as_pose(pose))
        deviation_m, deviation_rad = np.sqrt(self.keyframe_variance)
        self.filter.update(motion, (float(deviation_m), float(deviation_rad)), points.surfels, points.surface_m)
        self.drawing.add(points, self.filter.line[-1])
        self.keyframe_s = points.stamp_s
        self.keyframe_pose = self.filter.poses[self.filter.followed].copy()
        self.keyframe_variance = np.zeros(2)
        bent = self.loops.look(self.drawing, self.filter.line)
        if bent is not None:
            self.drawing.bend(bent, self.filter.line)
        forget_keyframes(self)

    def redraw(self) -> LoopClosed | None:
        """A few scans of a drawing in progress; when a bent one is done, everything stands on it."""
        field = self.drawing.follow(self.filter.line)
        if field is None:
            return None
        before = self.pose
        correction = self.drawing.correction
        line = np.vstack([self.filter.line[: self.drawing.oldest], self.drawing.poses])
        self.filter.adopt(line, field)
        self.pose, self.keyframe_pose = (composed(correction, pose[None])[0] for pose in (self.pose, self.keyframe_pose))
        return LoopClosed(*apart(as_pose(before), as_pose(self.pose)))

    def search_for(self, surfels: NDArray[np.float32], stamp_s: float) -> Relocalization:
        """A search for a scan on the whole map."""
        return Relocalization(self.drawing.coarse, surfels, stamp_s)

    def move_to(self, pose: NDArray[np.float64], stamp_s: float) -> None:
        """The robot was found again: everything goes on from here."""
        self.loops.breaks.append(len(self.filter.line))
        self.filter.poses = np.tile(pose, (self.filter.particles, 1))
        self.pose, self.last_scan_s = pose.copy(), stamp_s
        self.keyframe_pose, self.keyframe_s = pose.copy(), stamp_s
        self.keyframe_variance = np.zeros(2)

    def trajectory(self) -> NDArray[np.float64]:
        """(N, 4) stamp, x, y, theta at every accepted scan, as the followed particle remembers it now."""
        return self.scans.placed(self.filter.line)


def as_pose(xyt: NDArray[np.float64]) -> SE2:
    return SE2(float(xyt[0]), float(xyt[1]), wrap_angle(float(xyt[2])))


def as_array(pose: SE2) -> NDArray[np.float64]:
    return np.array([pose.x_m, pose.y_m, pose.theta_rad])
