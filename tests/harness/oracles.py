"""Slow, obvious versions of what the code does fast: tests compare the two."""

from __future__ import annotations

import numpy as np

from protocol.geometry import SE2
from protocol.grid import UNKNOWN, OccupancyGrid


def match_factor_counts(ours: OccupancyGrid, theirs: OccupancyGrid, T_ours_theirs: SE2) -> tuple[int, int, int]:
    """Equations (1) and (2), cell by cell; and how many centres lie so near an edge of their cells that rounding decides."""
    agree = disagree = on_an_edge = 0
    for row, col in np.argwhere(ours.cells != UNKNOWN):
        point = T_ours_theirs.inverse().apply(ours.points_of([(row, col)]))
        value, mine = theirs.values_at(point)[0], ours.cells[row, col]
        agree += int(value == mine)
        disagree += int(value not in (UNKNOWN, mine))
        in_cells = theirs.origin.inverse().apply(point)[0] / theirs.resolution_m
        on_an_edge += int(np.abs(in_cells - np.round(in_cells)).min() < 0.05)
    return agree, disagree, on_an_edge
