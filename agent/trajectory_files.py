"""Trajectories as TUM files, which evo and most other tools read: `stamp tx ty tz qx qy qz qw`, seconds and metres."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray


def tum_text(trajectory: NDArray[np.float64], first_stamp_s: float = 0.0) -> str:
    """(N, 4) stamp, x, y, theta; stamps ascend strictly in the file, a repeated one is left out."""
    lines, last = [], ""
    for stamp_s, x_m, y_m, theta_rad in trajectory[np.argsort(trajectory[:, 0], kind="stable")].tolist():
        stamp = f"{first_stamp_s + stamp_s:.6f}"
        if stamp != last:
            half = theta_rad / 2
            lines.append(f"{stamp} {x_m:.6f} {y_m:.6f} 0 0 0 {math.sin(half):.9f} {math.cos(half):.9f}\n")
        last = stamp
    return "".join(lines)
