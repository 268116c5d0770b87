"""A revolution of the LIDAR as points in the robot frame, as if measured in one moment.

Angles and times are per beam, so a spinning LIDAR may report another number of points each turn, and what it saw while
the robot turned is put where it belongs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from agent.mapping.motion import OdometryTrack, undo_motion
from agent.mapping.options import MappingOptions
from hw.readings import LaserScan
from protocol.geometry import SE2

VOXEL_M = 0.05  # one point a voxel for matching: a near wall must not outvote the rest of the room
ENOUGH_HITS = 80  # fewer than this within the matching range and the next ones are used too ...
FAR = 2.4  # ... up to this many times as far: 60 m
FACING_GAP_M = 0.4  # two neighbouring hits farther apart may be two things ...
WIDEST_GAP_M = 1.0  # ... unless a third lies in line with them
WIDEST_WALL_M = 1.0  # for its direction: at 3 m two of three seeds missed a loop of freiburg-079
STRAIGHT = np.float32(0.985)  # cosine of 10 degrees
STRAIGHT_CHORD = np.float32(0.8)  # cosine: chords that bend by more than 37 degrees meet in a corner
MOST_SURFELS = 180  # beams 2 degrees apart say what can be said; four times as many cost four times the time
WIDEST_BLIND_RAD = math.radians(30.0)  # of a LIDAR that looks all round: a mast, or a packet that was lost
STEEPEST = 0.85  # change of range per gap: beyond it the surface is seen so flat that it may be a depth jump


@dataclass(frozen=True, slots=True, eq=False)
class ScanPoints:
    """End points of the beams that returned, in the robot frame at `stamp_s`."""

    stamp_s: float
    points_m: NDArray[np.float32]  # (N, 2) every return, cut rays included
    is_hit: NDArray[np.bool_]  # (N,) False: the ray was cut at the matching range, something lies further on
    surfels: NDArray[np.float32]  # (M, 4) hits to match, one a voxel: x, y, and the unit normal there, (0, 0) where unknown
    surface_m: NDArray[np.float32]  # (K, 2) hits and the surfaces between neighbouring ones, one a voxel
    is_partial: bool
    is_all_round: bool  # from one place it sees the same, whichever way the robot looks
    revolution_s: float  # from its first beam to its last
    ranges_m: NDArray[np.float64]  # (N,) of every return, cut rays as far as the cut
    turns: NDArray[np.float32]  # (N,) when each was measured, in revolutions from stamp_s: -0.5 to 0.5
    surfel_turns: NDArray[np.float32]  # (M,) the same of the surfels

    def untwisted(self, twist_rad: float) -> ScanPoints:
        """As they are if the robot turned by this much more within the revolution than its wheels told."""
        if twist_rad == 0.0:
            return self
        x, y = self.points_m.T
        cos, sin = np.cos(twist_rad * self.turns), np.sin(twist_rad * self.turns)
        ends = np.stack([cos * x - sin * y, sin * x + cos * y], axis=1).astype(np.float32)
        surfels, surfel_turns = to_match(ends, self.is_hit, self.turns)
        surface_m = surface_points(ends, self.is_hit, self.ranges_m)
        return replace(self, points_m=ends, surfels=surfels, surface_m=surface_m, surfel_turns=surfel_turns)

    @property
    def n(self) -> int:
        return len(self.points_m)

    @property
    def matching_m(self) -> NDArray[np.float32]:
        """(M, 2) x and y of the surfels."""
        return self.surfels[:, :2]


def reference_stamp_s(scan: LaserScan) -> float:
    """The moment a scan speaks for: the middle of its revolution."""
    return scan.stamp_s + 0.5 * scan.duration_s


def scan_points(scan: LaserScan, track: OdometryTrack, options: MappingOptions) -> ScanPoints:
    """Every beam's end point, motion within the revolution undone."""
    ranges = np.asarray(scan.ranges_m, np.float64)
    is_return = np.isfinite(ranges) & (ranges >= max(scan.range_min_m, 1e-3)) & (ranges < scan.range_max_m)
    reach_m = matching_reach_m(ranges[is_return], options)
    cut = np.minimum(ranges[is_return], reach_m)
    angles = np.asarray(scan.angles_rad, np.float64)[is_return]
    points_laser = np.stack([cut * np.cos(angles), cut * np.sin(angles)], axis=1)
    points = options.T_base_laser.apply(points_laser)
    stamp_s = reference_stamp_s(scan)
    reference = track.pose_at(stamp_s)
    turns = np.zeros(len(points), np.float32)
    if scan.duration_s > 0.0 and reference is not None and len(points):
        stamps_s = beam_stamps_s(scan)[is_return]
        points = undo_motion(points, track.poses_at(stamps_s), reference)
        turns = ((stamps_s - stamp_s) / scan.duration_s).astype(np.float32)
    is_hit = ranges[is_return] < reach_m
    ends = points.astype(np.float32)
    surfels, surfel_turns = to_match(ends, is_hit, turns)
    return ScanPoints(
        stamp_s=stamp_s,
        points_m=ends,
        is_hit=is_hit,
        surfels=surfels,
        surface_m=surface_points(ends, is_hit, cut),
        is_partial=scan.is_partial,
        is_all_round=looks_all_round(scan.angles_rad),
        revolution_s=scan.duration_s,
        ranges_m=cut,
        turns=turns,
        surfel_turns=surfel_turns,
    )


def to_match(
    ends_m: NDArray[np.float32], is_hit: NDArray[np.bool_], turns: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(M, 4) surfels and (M,) when each was measured, in revolutions."""
    hits = np.flatnonzero(is_hit)
    hits = hits[first_per_voxel(ends_m[hits])]
    return thinned(with_normals(ends_m[hits]), MOST_SURFELS), thinned(turns[hits], MOST_SURFELS)


def surface_points(ends_m: NDArray[np.float32], is_hit: NDArray[np.bool_], ranges_m: NDArray[np.float64]) -> NDArray[np.float32]:
    """(K, 2) hits and the surfaces between neighbouring ones, one a voxel."""
    return one_per_voxel(np.vstack([one_per_voxel(ends_m[is_hit]), between(ends_m, is_hit, ranges_m)]))


def looks_all_round(angles_rad: NDArray[np.float32]) -> bool:
    """Whether beams go in every direction, returned or not."""
    sorted_rad = np.sort(angles_rad % np.float32(math.tau))
    return len(sorted_rad) > 0 and float(np.diff(sorted_rad, append=sorted_rad[0] + math.tau).max()) < WIDEST_BLIND_RAD


def matching_reach_m(returns_m: NDArray[np.float64], options: MappingOptions) -> float:
    """The matching range; on a wide place with little nearby, as much further as it takes to see enough."""
    if len(returns_m) == 0 or np.count_nonzero(returns_m < options.matching_range_m) >= ENOUGH_HITS:
        return options.matching_range_m
    enough_m = float(np.sort(returns_m)[min(ENOUGH_HITS, len(returns_m)) - 1]) + 0.01
    return min(max(enough_m, options.matching_range_m), FAR * options.matching_range_m)


def between(ends_m: NDArray[np.float32], is_hit: NDArray[np.bool_], ranges_m: NDArray[np.float64]) -> NDArray[np.float32]:
    """Points on the straight surface between neighbouring hits, a voxel apart.

    Without them a field of sparse beams is a row of dots, and the next scan's dots slide into them.
    """
    step_m = ends_m[1:] - ends_m[:-1]
    gap_m = np.hypot(step_m[:, 0], step_m[:, 1])
    is_surface = is_joined(step_m, gap_m, ranges_m, WIDEST_GAP_M) & is_hit[1:] & is_hit[:-1]
    inner = np.where(is_surface, np.ceil(gap_m / VOXEL_M) - 1, 0).astype(np.int64)
    first = np.repeat(np.arange(len(gap_m)), inner)
    share = (np.arange(len(first)) - np.repeat(np.cumsum(inner) - inner, inner) + 1) / (inner[first] + 1)
    return (ends_m[first] + share[:, None].astype(np.float32) * (ends_m[first + 1] - ends_m[first])).astype(np.float32)


def is_joined(
    step_m: NDArray[np.float32],
    gap_m: NDArray[np.float32],
    ranges_m: NDArray[np.float64] | NDArray[np.float32],
    widest_m: float,
) -> NDArray[np.bool_]:
    """(N - 1,) whether neighbouring points lie on one surface."""
    is_facing = (gap_m < FACING_GAP_M) & (np.abs(np.diff(ranges_m)) < STEEPEST * gap_m)
    return is_facing | (goes_on_straight(step_m, gap_m) & (gap_m < widest_m))


def with_normals(hits_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """(M, 4) points in beam order with the normal of the chord from two points before to two after; none at corners."""
    n = len(hits_m)
    surfels = np.zeros((n, 4), np.float32)
    surfels[:, :2] = hits_m
    if n < 3:
        return surfels
    step_m = hits_m[1:] - hits_m[:-1]
    joined = np.zeros(n + 3, bool)  # joined[i + 2]: point i and point i + 1
    joined[2 : n + 1] = is_joined(
        step_m, np.hypot(step_m[:, 0], step_m[:, 1]), np.hypot(hits_m[:, 0], hits_m[:, 1]), WIDEST_WALL_M
    )
    i = np.arange(n)
    before = np.where(joined[i + 1], np.where(joined[i], 2, 1), 0)
    after = np.where(joined[i + 2], np.where(joined[i + 3], 2, 1), 0)
    back, ahead = hits_m - hits_m[i - before], hits_m[i + after] - hits_m
    bend = (back * ahead).sum(axis=1) < STRAIGHT_CHORD * np.hypot(back[:, 0], back[:, 1]) * np.hypot(ahead[:, 0], ahead[:, 1])
    chord = back + ahead
    length = np.hypot(chord[:, 0], chord[:, 1])
    is_wall = (before + after > 1) & ~bend & (length > 0.5 * VOXEL_M)
    surfels[is_wall, 2] = -chord[is_wall, 1] / length[is_wall]
    surfels[is_wall, 3] = chord[is_wall, 0] / length[is_wall]
    return surfels


def thinned(rows: NDArray[np.float32], most: int) -> NDArray[np.float32]:
    """At most that many rows, evenly spread."""
    if len(rows) <= most:
        return rows
    return rows[np.arange(most) * len(rows) // most]


def goes_on_straight(step_m: NDArray[np.float32], gap_m: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Gaps in line with the gap before or after them: a wall seen at a flat angle, not the edge of a door."""
    along = (step_m[1:] * step_m[:-1]).sum(axis=1) > STRAIGHT * gap_m[1:] * gap_m[:-1]
    similar = (gap_m[1:] < 2.0 * gap_m[:-1]) & (gap_m[:-1] < 2.0 * gap_m[1:])
    is_straight = np.zeros(len(gap_m), bool)
    is_straight[1:] |= along & similar
    is_straight[:-1] |= along & similar
    return is_straight


def beam_stamps_s(scan: LaserScan) -> NDArray[np.float64]:
    """(N,) when each beam was measured."""
    if scan.time_offsets_s is not None:
        return scan.stamp_s + np.asarray(scan.time_offsets_s, np.float64)
    return scan.stamp_s + np.linspace(0.0, scan.duration_s, len(scan.ranges_m))


def one_per_voxel(points_m: NDArray[np.float32], voxel_m: float = VOXEL_M) -> NDArray[np.float32]:
    """The first point of every voxel, in beam order."""
    return points_m[first_per_voxel(points_m, voxel_m)]


def first_per_voxel(points_m: NDArray[np.float32], voxel_m: float = VOXEL_M) -> NDArray[np.int64]:
    """Which points those are."""
    keys = np.floor(points_m / voxel_m).astype(np.int64)
    _, first = np.unique(keys[:, 0] * 1_000_003 + keys[:, 1], return_index=True)
    return np.sort(first)


def laser_position_m(options: MappingOptions, T_map_robot: SE2) -> tuple[float, float]:
    """Where the LIDAR stands in the map frame."""
    T_map_laser = T_map_robot @ options.T_base_laser
    return T_map_laser.x_m, T_map_laser.y_m
