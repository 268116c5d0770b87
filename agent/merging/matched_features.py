"""Which features of two aligned maps are the same thing: what a person wants to see drawn when asking why maps merged."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protocol.features import FeatureMap, FeatureTable
from protocol.geometry import SE2, wrap_angles

SAME_DIRECTION_RAD = math.radians(6)
SAME_PLACE_M = 0.3  # across a line; between the centres of round things and curves
MIN_SHARED_M = 0.4  # of two lines, along them


@dataclass(frozen=True, slots=True, eq=False)
class MatchedFeatures:
    """(N, 2) row numbers, ours and theirs, of each kind; a feature appears once at most."""

    lines: NDArray[np.int64]
    circles: NDArray[np.int64]
    arcs: NDArray[np.int64]
    curves: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.lines) + len(self.circles) + len(self.arcs) + len(self.curves)


def matched_features(ours: FeatureMap, theirs: FeatureMap, T_ours_theirs: SE2) -> MatchedFeatures:
    """Pairs that coincide under the transform, the closest first."""
    return MatchedFeatures(
        _same_lines(ours.lines, theirs.lines, T_ours_theirs),
        _same_centres(ours.circles, theirs.circles, T_ours_theirs),
        _same_centres(ours.arcs, theirs.arcs, T_ours_theirs),
        _same_centres(ours.curves, theirs.curves, T_ours_theirs),
    )


def _same_lines(ours: FeatureTable, theirs: FeatureTable, T_ours_theirs: SE2) -> NDArray[np.int64]:
    """Lines that face the same way, lie on one another, and share a stretch."""
    angle, middle = ours[:, 2].astype(np.float64), ours[:, :2].astype(np.float64)
    turn = np.abs(wrap_angles(theirs[None, :, 2] + T_ours_theirs.theta_rad - angle[:, None]))
    away = T_ours_theirs.apply(theirs[:, :2])[None, :, :] - middle[:, None, :]
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=1)[:, None, :]
    across = np.abs((away * normal).sum(axis=2))
    along = np.abs(away[..., 1] * normal[..., 0] - away[..., 0] * normal[..., 1])
    shared = 0.5 * (ours[:, None, 3] + theirs[None, :, 3]) - along
    shared = np.minimum(shared, np.minimum(ours[:, None, 3], theirs[None, :, 3]))
    cost = np.where(
        (turn < SAME_DIRECTION_RAD) & (across < SAME_PLACE_M) & (shared > MIN_SHARED_M), across + turn - 0.1 * shared, np.inf
    )
    return _one_to_one(cost)


def _same_centres(ours: FeatureTable, theirs: FeatureTable, T_ours_theirs: SE2) -> NDArray[np.int64]:
    """Features of a similar size whose centres coincide."""
    away = T_ours_theirs.apply(theirs[:, :2])[None, :, :] - ours[:, None, :2]
    distance = np.hypot(away[..., 0], away[..., 1])
    size_column = 3 if ours.shape[1] == 5 else 2  # curves carry an orientation before their size
    mine, yours = ours[:, None, size_column], theirs[None, :, size_column]
    similar = np.abs(mine - yours) < 0.3 * np.maximum(mine, yours) + 0.05
    return _one_to_one(np.where((distance < SAME_PLACE_M) & similar, distance, np.inf))


def _one_to_one(cost: NDArray[np.float64]) -> NDArray[np.int64]:
    """Greedy pairs, the cheapest first, each row and column once."""
    rows, cols = np.nonzero(np.isfinite(cost))
    order = np.lexsort((cols, rows, cost[rows, cols]))
    used_rows, used_cols, pairs = set(), set(), []
    for row, col in zip(rows[order].tolist(), cols[order].tolist(), strict=True):
        if row not in used_rows and col not in used_cols:
            used_rows.add(row)
            used_cols.add(col)
            pairs.append((row, col))
    return np.array(pairs, np.int64).reshape(-1, 2)
