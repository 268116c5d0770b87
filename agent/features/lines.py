"""Wall lines, fitted by total least squares to the wall points that face one way and hang together.

The points are split into layers, one per peak of the histogram of their signed normals; the points of a layer are painted,
joined over gaps of about half a metre (doors stay gaps), and every connected piece that is straight is a line.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from agent.features.wall_points import WallPoints
from protocol.features import FeatureTable
from protocol.geometry import SE2

MIN_LENGTH_M = 0.8
MAX_AWAY_M = 0.15  # a point farther from its line is not on it
_TRIMS_M = (0.12, 0.08, 0.08)
MIN_LINEARITY = 0.5
MIN_POINTS = 4
LAYER_HALF_WIDTH_DEG = 17
MAX_LAYERS = 12
ALONG_CELL_M = 0.4  # gaps up to this are bridged: posts, not doors
ACROSS_CELL_M = 0.12  # parallel walls this far apart are two
MAX_LINES = 2000
SAMPLE_M = 0.3  # wall points closer than this do not err independently


@dataclass(frozen=True, slots=True, eq=False)
class WallLines:
    """One row a line, grid frame, the longest first."""

    middles_m: NDArray[np.float64]  # (N, 2)
    angles_rad: NDArray[np.float64]  # (N,) direction of the normal, towards the free side
    lengths_m: NDArray[np.float64]  # (N,)
    sigma_theta_rad: NDArray[np.float64]  # (N,)
    sigma_rho_m: NDArray[np.float64]  # (N,)
    is_distinct: NDArray[np.bool_]  # (N,) no longer line has most of its points: layers overlap, and may find a wall twice
    support_m: NDArray[np.float64]  # (wall points,) length of the line a wall point lies on, 0 for none

    def __len__(self) -> int:
        return len(self.angles_rad)

    @property
    def normals(self) -> NDArray[np.float64]:
        """(N, 2) unit vectors."""
        return np.stack([np.cos(self.angles_rad), np.sin(self.angles_rad)], axis=1)

    @property
    def rho_m(self) -> NDArray[np.float64]:
        """(N,) signed distance of the line from the origin, along its normal."""
        rho: NDArray[np.float64] = (self.normals * self.middles_m).sum(axis=1)
        return rho

    def table(self, T_map_grid: SE2) -> FeatureTable:
        """(N, 6) the lines as they travel: `protocol.features.LINE_COLUMNS`, map frame."""
        middles = T_map_grid.apply(self.middles_m)
        angles = np.remainder(self.angles_rad + T_map_grid.theta_rad + math.pi, math.tau) - math.pi
        columns = (*middles.T, angles, self.lengths_m, self.sigma_theta_rad, self.sigma_rho_m)
        return np.stack(columns, axis=1).astype(np.float32)


def wall_lines(walls: WallPoints, resolution_m: float) -> WallLines:
    """The straight pieces of wall of one map."""
    straight = np.flatnonzero(walls.linearity > MIN_LINEARITY)
    points, angles = walls.positions_m[straight].astype(np.float64), walls.angles_rad[straight]
    found, members, owners, lines = [np.zeros((0, 6))], [straight[:0]], [straight[:0]], 0
    for centre in _layer_centres(angles):
        mine = np.flatnonzero(angle_apart(angles, centre) < math.radians(LAYER_HALF_WIDTH_DEG))
        if len(mine) >= MIN_POINTS:
            rows, owner = _pieces(points[mine], centre, resolution_m)
            found.append(rows)
            members.append(straight[mine[owner >= 0]])
            owners.append(owner[owner >= 0] + lines)
            lines += len(rows)
    rows, member, owner = np.concatenate(found), np.concatenate(members), np.concatenate(owners)
    support = np.zeros(len(walls))
    np.maximum.at(support, member, rows[owner, 3])
    is_longest = rows[owner, 3] >= support[member]
    is_distinct = 2 * np.bincount(owner[is_longest], minlength=lines) >= np.bincount(owner, minlength=lines)
    order = np.argsort(-rows[:, 3], kind="stable")[:MAX_LINES]
    rows = rows[order]
    return WallLines(rows[:, :2], rows[:, 2], rows[:, 3], rows[:, 4], rows[:, 5], is_distinct[order], support)


def _layer_centres(angles_rad: NDArray[np.floating]) -> list[float]:
    """Directions (radians) around which the normals gather, the strongest first."""
    if not len(angles_rad):
        return []
    degrees = np.rint(np.degrees(angles_rad)).astype(np.int64) % 360
    counts = np.bincount(degrees, minlength=360).astype(np.float64)
    kernel = np.array([1, 2, 3, 4, 3, 2, 1]) / 16
    smooth = np.convolve(np.concatenate([counts[-3:], counts, counts[:3]]), kernel, mode="valid")
    centres = []
    for _ in range(MAX_LAYERS):
        peak = int(smooth.argmax())
        if smooth[peak] * 8 < max(8.0, 0.01 * len(angles_rad)):
            break
        centres.append(math.radians(peak))
        smooth[np.arange(peak - LAYER_HALF_WIDTH_DEG, peak + LAYER_HALF_WIDTH_DEG + 1) % 360] = 0
    return centres


def _pieces(mine: NDArray[np.float64], centre_rad: float, resolution_m: float) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """(N, 6) middle, angle, length, sigma_theta, sigma_rho of the lines in one layer; and every point's line, -1 for none."""
    normal = np.array([math.cos(centre_rad), math.sin(centre_rad)])
    tangent = np.array([normal[1], -normal[0]])  # so that (tangent, normal) is right-handed
    along, across = mine @ tangent, mine @ normal
    piece = _connected(along, across)
    pieces = int(piece.max()) + 1
    weight = np.ones(len(mine))
    for reach_m in _TRIMS_M:  # a bulge or a door frame must not tilt the wall
        n = np.maximum(np.bincount(piece, weight, pieces), 1e-9)
        mean_u, mean_v = np.bincount(piece, weight * along, pieces) / n, np.bincount(piece, weight * across, pieces) / n
        du, dv = along - mean_u[piece], across - mean_v[piece]
        suu, svv, suv = (np.bincount(piece, weight * w, pieces) / n for w in (du * du, dv * dv, du * dv))
        turn = 0.5 * np.arctan2(2 * suv, suu - svv)
        c, s = np.cos(turn), np.sin(turn)
        beside, ahead = dv * c[piece] - du * s[piece], du * c[piece] + dv * s[piece]
        weight = (np.abs(beside) < reach_m).astype(np.float64)
    n = np.bincount(piece, weight, pieces)
    rms = np.sqrt(np.bincount(piece, weight * beside**2, pieces) / np.maximum(n, 1))
    low, high = _extremes(ahead, piece, weight > 0, pieces)
    length = np.maximum(high - low, 0.0)
    keep = (length >= MIN_LENGTH_M) & (n >= MIN_POINTS) & (n >= 0.5 * np.bincount(piece, minlength=pieces))
    shift = 0.5 * (low + high)
    middles = (mean_u + shift * c)[:, None] * tangent + (mean_v + shift * s)[:, None] * normal
    sigma_rho = np.maximum(rms, 0.29 * resolution_m) / np.sqrt(np.maximum(2.0, length / SAMPLE_M))
    sigma_theta = math.sqrt(12) * sigma_rho / np.maximum(length, 1e-6)
    angle = np.remainder(centre_rad + turn + math.pi, math.tau) - math.pi
    rows = np.column_stack([middles, angle, length, sigma_theta, sigma_rho])[keep]
    line = np.where(keep, np.cumsum(keep) - 1, -1)
    return rows, np.where(np.abs(beside) < MAX_AWAY_M, line[piece], -1)


def angle_apart(angles_rad: NDArray[np.floating], centre_rad: float) -> NDArray[np.floating]:
    """Unsigned angle from a direction, in [0, pi]."""
    apart: NDArray[np.floating] = np.abs(np.remainder(angles_rad - centre_rad + math.pi, math.tau) - math.pi)
    return apart


def _connected(along_m: NDArray[np.float64], across_m: NDArray[np.float64]) -> NDArray[np.int64]:
    """(N,) number of the connected piece each point belongs to, 0 .. pieces - 1: joined along the wall, not across."""
    u = np.floor((along_m - along_m.min()) / ALONG_CELL_M).astype(np.int64) + 1
    v = np.floor((across_m - across_m.min()) / ACROSS_CELL_M).astype(np.int64) + 1
    image = np.zeros((int(v.max()) + 2, int(u.max()) + 2), np.uint8)
    image[v, u] = 1
    _, labels = cv2.connectedComponents(image, connectivity=8, ltype=cv2.CV_32S)
    pieces: NDArray[np.int64] = np.unique(labels[v, u], return_inverse=True)[1].astype(np.int64)
    return pieces


def _extremes(
    values: NDArray[np.float64], group: NDArray[np.int64], counted: NDArray[np.bool_], groups: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    low, high = np.full(groups, 1e9), np.full(groups, -1e9)
    np.minimum.at(low, group[counted], values[counted])
    np.maximum.at(high, group[counted], values[counted])
    return low, high
