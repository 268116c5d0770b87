"""Where the robot was at every accepted scan, each relative to the keyframe before it, so that it moves with the keyframe.

Forty bytes a scan and never more than KEPT_SCANS: of the older half every second scan is let go when there are too many, so
that a run of days stays whole and grows coarser with age.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from agent.mapping.scan_matching import Poses
from protocol.geometry import SE2

KEPT_SCANS = 30_000  # 1.2 MB; 50 minutes at 10 Hz until the first is let go


class Trajectory:
    """Rows of stamp, keyframe, and the pose in its frame."""

    def __init__(self) -> None:
        self._rows = np.empty((KEPT_SCANS, 5))
        self._n = 0

    def __len__(self) -> int:
        return self._n

    @property
    def rows(self) -> NDArray[np.float64]:
        """(N, 5) stamp, keyframe, x, y, theta."""
        return self._rows[: self._n]

    @rows.setter
    def rows(self, rows: NDArray[np.float64]) -> None:
        self._n = len(rows)
        self._rows[: self._n] = rows

    def add(self, stamp_s: float, keyframe: int, T_keyframe_robot: SE2) -> None:
        if self._n == KEPT_SCANS:
            half = KEPT_SCANS // 2
            self.rows = np.vstack([self._rows[:half:2], self._rows[half:]])
        self._rows[self._n] = stamp_s, keyframe, T_keyframe_robot.x_m, T_keyframe_robot.y_m, T_keyframe_robot.theta_rad
        self._n += 1

    def placed(self, line: Poses) -> NDArray[np.float64]:
        """(N, 4) stamp, x, y, theta along the path of keyframes, (K, 3)."""
        rows = self.rows
        frames = line[rows[:, 1].astype(np.int64)]
        cos, sin = np.cos(frames[:, 2]), np.sin(frames[:, 2])
        x = frames[:, 0] + cos * rows[:, 2] - sin * rows[:, 3]
        y = frames[:, 1] + sin * rows[:, 2] + cos * rows[:, 3]
        return np.stack([rows[:, 0], x, y, frames[:, 2] + rows[:, 4]], axis=1)
