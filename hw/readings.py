"""What the senses report: one scan, one odometry sample.  Readings never travel, so they live here and not in `protocol`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class LaserScan:
    """One whole revolution (or sweep) of a planar LIDAR, in the laser frame (x forward, counter-clockwise).

    No return within range is `inf`, an invalid beam is `nan` (REP-117).  Angles are per beam, because spinning LIDARs
    report a different number of points each turn.  Beam i was measured at `stamp_s + time_offsets_s[i]`.
    """

    stamp_s: float  # monotonic time of the first beam
    ranges_m: NDArray[np.float32]  # (N,)
    angles_rad: NDArray[np.float32]  # (N,)
    range_min_m: float
    range_max_m: float
    duration_s: float = 0.0  # first beam to last beam
    intensities: NDArray[np.float32] | None = None  # (N,)
    time_offsets_s: NDArray[np.float32] | None = None  # (N,), None: linear over duration_s in beam order
    is_partial: bool = False  # coverage below 95 %: never clears free space


@dataclass(frozen=True, slots=True)
class Odometry:
    """Integrated wheel motion in the odometry frame (continuous, drifts).

    `is_discontinuity` marks the first sample after a reset, a jump or a gap: motion since the sample before is not known
    and must not be integrated.
    """

    stamp_s: float
    x_m: float
    y_m: float
    theta_rad: float
    is_discontinuity: bool = False
