"""Candidates pulled into place: symmetric point-to-line Gauss-Newton, all candidates at once.

Wall points of either map are drawn to the local line of the nearest wall point of the other, where the two face the same
way.  The gate narrows from 0.8 m to 0.15 m, so a candidate may start a coarse cell off and ends below a tenth of one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent.features.field import MatchField
from agent.features.wall_points import WallPoints
from agent.merging.scoring import looked_up, placed
from agent.merging.transforms import Poses, inverted

SIGMA_M = 0.05  # how far wall points of two good maps lie apart
MIN_COSINE = 0.7
MIN_LINEARITY = 0.5
GATES_M = (0.8, 0.6, 0.4, 0.3, 0.2, 0.15)
FINE_GATES_M = (0.3, 0.2, 0.15, 0.15)
_Floats = NDArray[np.floating]
_STIFFNESS = 1e-3  # times the points: keeps an unobservable direction still

# How far a refined transform may be off.  Points err together: all of a wall is drawn on one side of its cells' middles, and a
# map bends as a whole.  So one point in fourteen tells something new, and none of them how one map is bent against the other.
# Measured: squared normalised errors of 109 pairs of recordings have a mean of 1.07 a dimension, 90 % are in the 95 % ellipsoid.
_POINTS_THAT_ERR_ALIKE = 14.0
_BENT_M, _BENT_RAD = 0.01, 6.4e-4
_PRIOR_POINTS = 10.0  # of residual SIGMA_M, believed before any is seen: a handful that agrees by chance proves little


@dataclass(frozen=True, slots=True, eq=False)
class Side:
    """What refinement needs of one map."""

    xy1: NDArray[np.float32]  # (3, P) the points it offers
    normals: NDArray[np.float32]  # (P, 2)
    field: MatchField
    walls: NDArray[
        np.float32
    ]  # (4, N + 1) x, y and normal of all wall points, zero normals where too curved to pull; last: none near

    @staticmethod
    def of(thin: WallPoints, walls: WallPoints, field: MatchField, count: int) -> Side:
        straight = np.flatnonzero(thin.linearity > MIN_LINEARITY)
        if len(straight) > count:
            straight = straight[np.linspace(0, len(straight) - 1, count).astype(np.int64)]
        xy1 = np.ones((3, len(straight)), np.float32)
        xy1[:2] = thin.positions_m[straight].T
        usable = (walls.linearity > MIN_LINEARITY)[:, None]
        all_walls = np.zeros((4, len(walls) + 1), np.float32)
        all_walls[:2, :-1], all_walls[2:, :-1] = walls.positions_m.T, (walls.normals * usable).T
        return Side(xy1, thin.normals[straight], field, all_walls)


@dataclass(frozen=True, slots=True, eq=False)
class Normal:
    """Normal equations of every candidate about the middle of its inliers."""

    H: NDArray[np.float64]  # (C, 3, 3)
    g: NDArray[np.float64]  # (C, 3)
    centre: NDArray[np.float64]  # (C, 2) in our frame
    inliers: NDArray[np.float64]  # (C,)
    weight: NDArray[np.float64]  # (C,) of all inliers
    squares: NDArray[np.float64]  # (C,) weighted sum of squared residuals

    def covariances(self) -> NDArray[np.float64]:
        """(C, 3, 3) of shifts and turn about the middle of the inliers, as wide as this pair's own residuals say."""
        spread = (self.squares + _PRIOR_POINTS * SIGMA_M**2) / (self.weight + _PRIOR_POINTS)
        about = np.linalg.inv(self.H + 1e-3 * np.eye(3)) * (_POINTS_THAT_ERR_ALIKE * spread)[:, None, None]
        return np.asarray(about + np.diag([_BENT_M**2, _BENT_M**2, _BENT_RAD**2]))


def refined(ours: Side, theirs: Side, poses: Poses, gates_m: tuple[float, ...] = GATES_M) -> Poses:
    """The candidates after one Gauss-Newton step a gate."""
    poses = np.array(poses, np.float64)
    for gate_m in gates_m:
        poses = stepped(poses, normal_equations(ours, theirs, poses, gate_m))
    return poses


def stepped(poses: Poses, normal: Normal) -> Poses:
    """One Gauss-Newton step, bounded to half a metre and six degrees."""
    stiff = (_STIFFNESS * normal.inliers + 1e-6)[:, None, None] * np.eye(3)
    step = -np.linalg.solve(normal.H + stiff, normal.g[..., None])[..., 0]
    length = np.hypot(step[:, 0], step[:, 1])
    step[:, :2] *= np.minimum(1.0, 0.5 / np.maximum(length, 1e-9))[:, None]
    turn = np.clip(step[:, 2], -0.1, 0.1)
    c, s = np.cos(turn), np.sin(turn)
    away = poses[:, :2] - normal.centre
    x = normal.centre[:, 0] + c * away[:, 0] - s * away[:, 1] + step[:, 0]
    y = normal.centre[:, 1] + s * away[:, 0] + c * away[:, 1] + step[:, 1]
    return np.stack([x, y, np.remainder(poses[:, 2] + turn + math.pi, math.tau) - math.pi], axis=1)


def normal_equations(ours: Side, theirs: Side, poses: Poses, gate_m: float) -> Normal:
    """Both directions, everything expressed in our frame."""
    c, s = np.cos(poses[:, 2])[:, None], np.sin(poses[:, 2])[:, None]
    # their points on our lines
    px, py, qx, qy, nx, ny, own = _partners(theirs, ours, poses)
    tx, ty = poses[:, :1] + c * px - s * py, poses[:, 1:2] + s * px + c * py
    facing = nx * (c * own[0] - s * own[1]) + ny * (s * own[0] + c * own[1])
    forth = _terms(tx, ty, tx - qx, ty - qy, nx, ny, facing, gate_m)
    # our points on their lines
    px, py, qx, qy, nx, ny, own = _partners(ours, theirs, inverted(poses))
    rx, ry = poses[:, :1] + c * qx - s * qy, poses[:, 1:2] + s * qx + c * qy
    mx, my = c * nx - s * ny, s * nx + c * ny
    back = _terms(rx, ry, rx - px, ry - py, mx, my, mx * own[0] + my * own[1], gate_m)
    x, y, e, nx, ny, w = (np.concatenate(pair, axis=1) for pair in zip(forth, back, strict=True))
    inliers = np.maximum((w > 0).sum(axis=1), 1).astype(np.float64)
    total = np.maximum(w.sum(axis=1), 1e-9)
    centre = np.stack([(w * x).sum(axis=1), (w * y).sum(axis=1)], axis=1) / total[:, None]
    lever = ny * (x - centre[:, :1].astype(np.float32)) - nx * (y - centre[:, 1:].astype(np.float32))
    J = np.stack([nx, ny, lever], axis=1)  # (C, 3, P)
    weighted = J * w[:, None, :]
    H = (weighted @ J.transpose(0, 2, 1)).astype(np.float64)
    g = (weighted @ e[..., None])[..., 0].astype(np.float64)
    return Normal(H, g, centre, inliers, total.astype(np.float64), (w * e * e).sum(axis=1).astype(np.float64))


def _partners(points: Side, lines: Side, poses: Poses) -> tuple[_Floats, ...]:
    """Points (1, P), and for every candidate the nearest wall point of the other map (C, P) with its normal."""
    columns, rows = placed(points.xy1, poses, lines.field.resolution_m)
    found = looked_up(lines.field.nearest, columns, rows, outside=-1)
    index = found.astype(np.int32)
    qx, qy, nx, ny = (column.take(index) for column in lines.walls)
    return points.xy1[:1], points.xy1[1:2], qx, qy, nx, ny, points.normals.T


def _terms(
    x: _Floats, y: _Floats, ex: _Floats, ey: _Floats, nx: _Floats, ny: _Floats, facing: _Floats, gate_m: float
) -> tuple[_Floats, ...]:
    """Place, residual, normal and weight of every pair; weight zero where it does not count."""
    e = nx * ex + ny * ey
    keep = (facing > MIN_COSINE) & (ex * ex + ey * ey < (gate_m + 0.1) ** 2) & (np.abs(e) < gate_m)
    soft = max(2 * SIGMA_M, 0.3 * gate_m)
    w = np.where(keep, 1.0 / (1.0 + (e / soft) ** 2), 0.0).astype(np.float32)
    return (*(v.astype(np.float32) for v in (x, y, e, nx, ny)), w)
