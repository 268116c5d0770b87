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
MAX_RMS_M = 0.15
MIN_LINEARITY = 0.5
LAYER_HALF_WIDTH_DEG = 17
MAX_LAYERS = 12
PAINT_CELL_M = 0.2
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
    found = [_pieces(points, angles, centre, resolution_m) for centre in _layer_centres(angles)]
    rows = np.concatenate([np.zeros((0, 6)), *found])
    rows = rows[np.argsort(-rows[:, 3], kind="stable")[:MAX_LINES]]
    return WallLines(rows[:, :2], rows[:, 2], rows[:, 3], rows[:, 4], rows[:, 5])


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


def _pieces(
    points: NDArray[np.float64], angles: NDArray[np.floating], centre_rad: float, resolution_m: float
) -> NDArray[np.float64]:
    """(N, 6) middle, angle, length, sigma_theta, sigma_rho of the lines in one layer."""
    away = np.abs(np.remainder(angles - centre_rad + math.pi, math.tau) - math.pi)
    mine = points[away < math.radians(LAYER_HALF_WIDTH_DEG)]
    if len(mine) < 4:
        return np.zeros((0, 6))
    normal = np.array([math.cos(centre_rad), math.sin(centre_rad)])
    tangent = np.array([normal[1], -normal[0]])  # so that (tangent, normal) is right-handed
    along, across = mine @ tangent, mine @ normal
    piece = _connected(mine)
    n = np.bincount(piece).astype(np.float64)
    mean_u, mean_v = np.bincount(piece, along) / n, np.bincount(piece, across) / n
    du, dv = along - mean_u[piece], across - mean_v[piece]
    suu, svv, suv = (np.bincount(piece, w) / n for w in (du * du, dv * dv, du * dv))
    turn = 0.5 * np.arctan2(2 * suv, suu - svv)
    across_line = dv * np.cos(turn)[piece] - du * np.sin(turn)[piece]
    along_line = du * np.cos(turn)[piece] + dv * np.sin(turn)[piece]
    rms = np.sqrt(np.bincount(piece, across_line**2) / n)
    low, high = _extremes(along_line, piece, len(n))
    length = high - low
    keep = (length >= MIN_LENGTH_M) & (rms < MAX_RMS_M) & (n >= 4)
    shift = 0.5 * (low + high)
    middle_u, middle_v = mean_u + shift * np.cos(turn), mean_v + shift * np.sin(turn)
    middles = middle_u[:, None] * tangent + middle_v[:, None] * normal
    spread = np.maximum(rms, 0.29 * resolution_m)
    independent = np.sqrt(np.maximum(2.0, length / SAMPLE_M))
    sigma_rho = spread / independent
    sigma_theta = math.sqrt(12) * sigma_rho / np.maximum(length, 1e-6)
    angle = np.remainder(centre_rad + turn + math.pi, math.tau) - math.pi
    return np.column_stack([middles, angle, length, sigma_theta, sigma_rho])[keep]


def _connected(points_m: NDArray[np.float64]) -> NDArray[np.int32]:
    """(N,) number of the connected piece each point belongs to, 0 .. pieces - 1."""
    cells = np.floor((points_m - points_m.min(axis=0)) / PAINT_CELL_M).astype(np.int32) + 1
    width, height = cells.max(axis=0) + 2
    image = np.zeros((height, width), np.uint8)
    image[cells[:, 1], cells[:, 0]] = 1
    image = cv2.dilate(image, np.ones((3, 3), np.uint8))
    _, labels = cv2.connectedComponents(image, connectivity=8, ltype=cv2.CV_32S)
    return np.unique(labels[cells[:, 1], cells[:, 0]], return_inverse=True)[1].astype(np.int32)


def _extremes(values: NDArray[np.float64], group: NDArray[np.int32], groups: int) -> tuple[NDArray[np.float64], ...]:
    low, high = np.full(groups, np.inf), np.full(groups, -np.inf)
    np.minimum.at(low, group, values)
    np.maximum.at(high, group, values)
    return low, high
