"""Exact ranges from segments, fast enough for three robots on one core.

Each segment covers an interval of bearings as seen from the middle of the rays' origins, widened by what the origins move
within the batch; only the rays inside that interval are tried against it.  That turns rays x segments into about rays x depth
of clutter, and loses nothing: the intersection itself is solved per ray from its own origin.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def cast(segments: Floats, origins_m: Floats, bearings_rad: Floats, max_range_m: float) -> tuple[Floats, Floats]:
    """Distance of the first wall on each ray (`inf` beyond `max_range_m`), and cosine of incidence there.

    segments (S, 4), origins_m (N, 2), bearings_rad (N,) in the world frame; returns two (N,) arrays.
    """
    ranges_m = np.full(len(bearings_rad), np.inf)
    if not len(segments) or not len(bearings_rad):
        return ranges_m, np.ones(len(bearings_rad))
    rays, walls = _candidates(segments, origins_m, bearings_rad, max_range_m)
    t = _intersections(segments[walls], origins_m[rays], bearings_rad[rays])
    is_hit = t <= max_range_m
    rays, walls, t = rays[is_hit], walls[is_hit], t[is_hit]
    np.minimum.at(ranges_m, rays, t)
    return ranges_m, _incidence(segments, bearings_rad, ranges_m, rays, walls, t)


def cast_all(segments: Floats, origins_m: Floats, bearings_rad: Floats, max_range_m: float) -> Floats:
    """Every ray against every segment: the slow, obvious version that `cast` is tested against."""
    n, s = len(bearings_rad), len(segments)
    rays, walls = np.repeat(np.arange(n), s), np.tile(np.arange(s), n)
    t = _intersections(segments[walls], origins_m[rays], bearings_rad[rays]).reshape(n, s)
    nearest = t.min(axis=1) if s else np.full(n, np.inf)
    return np.where(nearest <= max_range_m, nearest, np.inf)


def _candidates(
    segments: Floats, origins_m: Floats, bearings_rad: Floats, max_range_m: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs (ray, segment) that may meet: a superset of those that do."""
    middle = (origins_m.min(axis=0) + origins_m.max(axis=0)) / 2
    moved_m = float(np.hypot(*(origins_m - middle).T).max()) + 1e-9
    distances_m = segment_distances(segments, middle)
    near = np.flatnonzero(distances_m <= max_range_m + moved_m)
    ends = segments[near] - np.tile(middle, 2)
    a = np.arctan2(ends[:, 1], ends[:, 0])
    sweep = (np.arctan2(ends[:, 3], ends[:, 2]) - a + math.pi) % math.tau - math.pi
    # From within `moved_m` of the middle, a point at distance d is seen at most asin(moved_m / d) off its bearing.
    margin = np.where(
        distances_m[near] > 2 * moved_m, np.arcsin(np.minimum(1.0, moved_m / np.maximum(distances_m[near], 1e-12))), math.pi
    )
    low = np.minimum(a, a + sweep) - margin - 1e-9
    width = np.minimum(np.abs(sweep) + 2 * margin + 2e-9, math.tau)
    return _rays_in_intervals(bearings_rad, low, width, near)


def _rays_in_intervals(
    bearings_rad: Floats, low: Floats, width: Floats, near: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """All rays whose bearing lies in [low, low + width] on the circle, for each interval."""
    turned = bearings_rad % math.tau
    order = np.argsort(turned)
    n = len(order)
    twice = np.concatenate([turned[order], turned[order] + math.tau])  # so that an interval across zero stays one slice
    begin = low % math.tau
    first = np.searchsorted(twice, begin, side="left")
    counts = np.minimum(np.searchsorted(twice, begin + width, side="right") - first, n)
    owner = np.repeat(np.arange(len(near)), counts)
    place = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts) + first[owner]
    return order[place % n], near[owner]


def _intersections(walls: Floats, origins_m: Floats, bearings_rad: Floats) -> Floats:
    """Distance along each ray to its own wall, `inf` when it passes by."""
    dx, dy = np.cos(bearings_rad), np.sin(bearings_rad)
    ex, ey = walls[:, 2] - walls[:, 0], walls[:, 3] - walls[:, 1]
    px, py = walls[:, 0] - origins_m[:, 0], walls[:, 1] - origins_m[:, 1]
    cross = dx * ey - dy * ex
    with np.errstate(divide="ignore", invalid="ignore"):
        along_ray = (px * ey - py * ex) / cross
        along_wall = (px * dy - py * dx) / cross
    passes = (along_ray < 0) | (along_wall < -1e-9) | (along_wall > 1 + 1e-9) | (np.abs(cross) < 1e-12)
    return np.where(passes, np.inf, along_ray)


def _incidence(
    segments: Floats, bearings_rad: Floats, ranges_m: Floats, rays: NDArray[np.int64], walls: NDArray[np.int64], t: Floats
) -> Floats:
    """|cos| of the angle between each ray and the normal of the wall it met; 1 where it met none."""
    cosines = np.ones(len(bearings_rad))
    winners = np.flatnonzero(t == ranges_m[rays])
    w = segments[walls[winners]]
    length_m = np.hypot(w[:, 2] - w[:, 0], w[:, 3] - w[:, 1])
    bearing = bearings_rad[rays[winners]]
    cosines[rays[winners]] = np.abs((w[:, 3] - w[:, 1]) * np.cos(bearing) - (w[:, 2] - w[:, 0]) * np.sin(bearing)) / length_m
    return cosines


def segment_distances(segments: Floats, point: Floats) -> Floats:
    """(S,) distance from one point to each segment."""
    ax, ay = segments[:, 0] - point[0], segments[:, 1] - point[1]
    ex, ey = segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1]
    t = np.clip(-(ax * ex + ay * ey) / np.maximum(ex * ex + ey * ey, 1e-18), 0.0, 1.0)
    return np.asarray(np.hypot(ax + t * ex, ay + t * ey))
