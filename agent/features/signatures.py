"""What a place looks like from a wall point: how near walls are, on rings around it, in the point's own signed frame.

Samples in unknown space are masked, so a place is recognised from the part both maps have seen.  This describes circles,
arcs and any other curve as well as lines, and needs no model of them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from agent.features.structure import LOOSE
from agent.features.wall_points import WallPoints

RINGS_M = (0.6, 1.1, 1.7, 2.5, 3.5, 4.8)
SECTORS = 24
MAX_QUERIES, QUERY_SPACING_M = 400, 0.75
MAX_TARGETS, TARGET_SPACING_M = 1600, 0.35
MAX_DENSE_TARGETS = 6000  # all the walls of a 250 m campus: a small map may lie where nothing is telling
_STRUCTURE_CELL_M = 1.5


@dataclass(frozen=True, slots=True, eq=False)
class Signatures:
    """One row a wall point, the most telling first; queries are a sparser choice of the same."""

    positions_m: NDArray[np.float32]  # (N, 2) grid frame
    angles_rad: NDArray[np.float32]  # (N,) of the normal
    values: NDArray[np.float32]  # (N, 144) 1 on a wall .. 0 far from any; 0 where not known
    known: NDArray[np.float32]  # (N, 144) 1 where known
    queries: NDArray[np.int64]  # rows

    def __len__(self) -> int:
        return len(self.positions_m)


def signatures_of(
    walls: WallPoints,
    kinds: NDArray[np.uint8],
    distance_m: NDArray[np.float32],
    known: NDArray[np.bool_],
    resolution_m: float,
    limit: int = MAX_TARGETS,
) -> Signatures:
    """Signatures of the firm wall points of one map."""
    firm = np.flatnonzero((kinds != LOOSE) & (walls.linearity > 0.3))
    firm = firm[np.argsort(-_structure(walls, firm), kind="stable")]
    targets = firm[_spread(walls.positions_m[firm], TARGET_SPACING_M)[:limit]]
    positions, angles = walls.positions_m[targets], walls.angles_rad[targets]
    values, seen = _sampled(positions, angles, distance_m, known, resolution_m)
    queries = _spread(positions, QUERY_SPACING_M)[:MAX_QUERIES]
    return Signatures(positions, angles, values, seen, queries)


def _structure(walls: WallPoints, rows: NDArray[np.int64]) -> NDArray[np.float64]:
    """(R,) how much the normals around each point vary, times how straight the walls are: neither corridor nor bush."""
    if not len(rows):
        return np.zeros(0)
    cell = np.floor(walls.positions_m[rows] / _STRUCTURE_CELL_M).astype(np.int64)
    cell -= cell.min(axis=0) - 1
    width, height = (int(v) + 2 for v in cell.max(axis=0))
    nx, ny = walls.normals[rows].T.astype(np.float64)
    key = cell[:, 1] * width + cell[:, 0]

    def around(weights: NDArray[np.float64]) -> NDArray[np.float64]:
        image = np.bincount(key, weights, width * height).reshape(height, width)
        sums: NDArray[np.float64] = cv2.boxFilter(image, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
        return np.asarray(sums.ravel()[key])

    n, linear = around(np.ones(len(rows))), around(walls.linearity[rows].astype(np.float64))
    xx, yy, xy = around(nx * nx), around(ny * ny), around(nx * ny)
    anisotropy = 2 * np.hypot(0.5 * (xx - yy), xy) / n
    return np.asarray((1.02 - anisotropy) * linear / n)


def _spread(positions_m: NDArray[np.float32], spacing_m: float) -> NDArray[np.int64]:
    """Rows of the first point of every voxel, in the order given."""
    if not len(positions_m):
        return np.zeros(0, np.int64)
    voxel = np.floor(positions_m / spacing_m).astype(np.int64)
    return np.sort(np.unique((voxel[:, 0] << 32) + voxel[:, 1], return_index=True)[1])


def _sampled(
    positions: NDArray[np.float32],
    angles: NDArray[np.float32],
    distance_m: NDArray[np.float32],
    known: NDArray[np.bool_],
    resolution_m: float,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    radius = np.repeat(np.array(RINGS_M, np.float32), SECTORS)
    bearing = np.tile(np.arange(SECTORS, dtype=np.float32) * (math.tau / SECTORS), len(RINGS_M))
    at = angles[:, None] + bearing[None, :]
    x = (positions[:, :1] + radius * np.cos(at)) / resolution_m - 0.5
    y = (positions[:, 1:] + radius * np.sin(at)) / resolution_m - 0.5
    if not len(positions):
        return np.zeros((0, len(radius)), np.float32), np.zeros((0, len(radius)), np.float32)
    far, border = 9.0, cv2.BORDER_CONSTANT
    distance = cv2.remap(distance_m, x, y, cv2.INTER_NEAREST, borderMode=border, borderValue=far)
    seen = cv2.remap(known.astype(np.float32), x, y, cv2.INTER_NEAREST, borderMode=border, borderValue=0)
    return np.maximum(0.0, 1.0 - distance / (0.3 + 0.24 * radius)).astype(np.float32) * seen, seen
