"""The feature map of a grid: what is extracted, matched, sent, and what a person can read (the paper's Table 1).

Every kind is one float32 array, one feature a row, columns named below, metres and radians in the map frame.  Angles that
carry a sign point from the wall to the free side, so a line has a direction over the full turn.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

LINE_COLUMNS = ("x_m", "y_m", "normal_rad", "length_m", "sigma_theta_rad", "sigma_rho_m")  # (x, y): mid-point
CIRCLE_COLUMNS = ("x_m", "y_m", "radius_m", "sigma_m")
ARC_COLUMNS = ("x_m", "y_m", "radius_m", "start_rad", "span_rad", "sigma_m")  # counter-clockwise from start
CURVE_COLUMNS = ("x_m", "y_m", "orientation_rad", "size_m", "sigma_m")  # centre of mass, regression line, arc length

FeatureTable = NDArray[np.float32]


def _empty(columns: tuple[str, ...]) -> FeatureTable:
    return np.zeros((0, len(columns)), np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class FeatureMap:
    """Lines, circles, arcs and remaining curves of one grid."""

    lines: FeatureTable = field(default_factory=lambda: _empty(LINE_COLUMNS))  # (N, 6)
    circles: FeatureTable = field(default_factory=lambda: _empty(CIRCLE_COLUMNS))  # (N, 4)
    arcs: FeatureTable = field(default_factory=lambda: _empty(ARC_COLUMNS))  # (N, 6)
    curves: FeatureTable = field(default_factory=lambda: _empty(CURVE_COLUMNS))  # (N, 5)

    def __len__(self) -> int:
        return len(self.lines) + len(self.circles) + len(self.arcs) + len(self.curves)
