"""Where the robot was at every accepted scan, each relative to the keyframe before it, so that it moves with the keyframe.

Twenty-four bytes a scan and never more than KEPT_SCANS: of the older half every second scan is let go when there are too many,
so that a run of days stays whole and grows coarser with age.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from agent.mapping.particle_filter import composed, inverted
from agent.mapping.scan_matching import Poses
from protocol.geometry import SE2

KEPT_SCANS = 16_384  # 0.4 MB; 27 minutes at 10 Hz until the first is let go
ROW = np.dtype([("stamp_s", "<f8"), ("keyframe", "<i4"), ("pose", "<f4", 3)])


class Trajectory:
    """Rows of stamp, keyframe, and the pose in its frame."""

    def __init__(self) -> None:
        self._rows = np.empty(KEPT_SCANS, ROW)
        self._n = 0

    def __len__(self) -> int:
        return self._n

    @property
    def rows(self) -> NDArray[Any]:
        """(N,) of ROW."""
        return self._rows[: self._n]

    @rows.setter
    def rows(self, rows: NDArray[Any]) -> None:
        self._n = len(rows)
        self._rows[: self._n] = rows

    def add(self, stamp_s: float, keyframe: int, T_keyframe_robot: SE2) -> None:
        if self._n == KEPT_SCANS:
            half = KEPT_SCANS // 2
            self.rows = np.concatenate([self._rows[:half:2], self._rows[half:]])
        pose = T_keyframe_robot.x_m, T_keyframe_robot.y_m, T_keyframe_robot.theta_rad
        self._rows[self._n] = stamp_s, keyframe, pose
        self._n += 1

    def rebase(self, keyframes: NDArray[np.int64], line: Poses, numbers: NDArray[np.int64]) -> None:
        """Tell every scan by keyframe `keyframes[k]` instead of k of the path (K, 3), and call that one `numbers[k]`."""
        rows = self.rows
        old = rows["keyframe"].astype(np.int64)
        new = keyframes[old]
        moved = new != old
        between = composed(inverted(line[new[moved]]), line[old[moved]])
        rows["pose"][moved] = composed(between, rows["pose"][moved].astype(np.float64))
        rows["keyframe"] = numbers[new]

    def placed(self, line: Poses) -> NDArray[np.float64]:
        """(N, 4) stamp, x, y, theta along the path of keyframes, (K, 3)."""
        rows = self.rows
        pose = rows["pose"].astype(np.float64)
        frames = line[rows["keyframe"]]
        cos, sin = np.cos(frames[:, 2]), np.sin(frames[:, 2])
        x = frames[:, 0] + cos * pose[:, 0] - sin * pose[:, 1]
        y = frames[:, 1] + sin * pose[:, 0] + cos * pose[:, 1]
        return np.stack([rows["stamp_s"], x, y, frames[:, 2] + pose[:, 2]], axis=1)
