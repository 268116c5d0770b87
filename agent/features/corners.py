"""Corners: where two wall lines meet, or would.  A corner is a full frame, so one matched pair fixes a transform.

It stays put when exploration, a door or a cupboard cuts its lines short, which a line's mid-point and length do not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent.features.lines import WallLines

MAX_CORNERS = 250
MAX_GAP_M = 4.0  # from the nearer end of either line to the corner
MIN_SINE = 0.5  # sharper angles place the corner badly
LINES_CONSIDERED = 400  # the longest; pairs grow with the square


@dataclass(frozen=True, slots=True, eq=False)
class Corners:
    """One row a corner, grid frame, the best first."""

    positions_m: NDArray[np.float64]  # (N, 2)
    directions_rad: NDArray[np.float64]  # (N,) bisector of the two normals
    openings_rad: NDArray[np.float64]  # (N,) angle from the first normal to the second, in (0, pi)
    quality: NDArray[np.float64]  # (N,) metres: short lines and wide gaps count less
    convex: NDArray[np.bool_]  # (N,) True: free space is inside the angle of the two lines (a room's corner)

    def __len__(self) -> int:
        return len(self.positions_m)


def corners_of(lines: WallLines) -> Corners:
    """The corners of one map's lines."""
    n = min(len(lines), LINES_CONSIDERED)
    normals, rho, angles = lines.normals[:n], lines.rho_m[:n], lines.angles_rad[:n]
    opening = np.remainder(angles[None, :] - angles[:, None], math.tau)
    first, second = np.nonzero((np.sin(opening) > MIN_SINE) & (opening < math.pi))
    det = np.sin(opening[first, second])
    n1, n2, r1, r2 = normals[first], normals[second], rho[first], rho[second]
    position = np.stack([r1 * n2[:, 1] - r2 * n1[:, 1], r2 * n1[:, 0] - r1 * n2[:, 0]], axis=1) / det[:, None]
    gap1, gap2 = _beyond_end(position, lines, first), _beyond_end(position, lines, second)
    length = np.minimum(np.minimum(lines.lengths_m[first], lines.lengths_m[second]), 4.0)
    quality = length - 0.5 * np.maximum(gap1, gap2)
    near = np.flatnonzero((gap1 <= MAX_GAP_M) & (gap2 <= MAX_GAP_M))
    best = near[np.argsort(-quality[near], kind="stable")[:MAX_CORNERS]]
    middle = angles[first] + 0.5 * opening[first, second]
    # seen from the corner, a room's walls lie on the free side of one another
    convex = (lines.middles_m[second] - position) * n1 + (lines.middles_m[first] - position) * n2
    return Corners(
        position[best],
        np.remainder(middle[best] + math.pi, math.tau) - math.pi,
        opening[first, second][best],
        quality[best],
        convex[best].sum(axis=1) > 0,
    )


def _beyond_end(position: NDArray[np.float64], lines: WallLines, which: NDArray[np.int64]) -> NDArray[np.float64]:
    """How far beyond the nearer end of its line a corner lies, zero when on it."""
    normals = lines.normals[which]
    away = position - lines.middles_m[which]
    along = away[:, 1] * normals[:, 0] - away[:, 0] * normals[:, 1]
    gap: NDArray[np.float64] = np.maximum(np.abs(along) - 0.5 * lines.lengths_m[which], 0.0)
    return gap
