"""Rigid motions of the plane, and angles that wrap.

`T_a_b` takes points in frame b to frame a, so `T_a_b @ T_b_c` is `T_a_c`: the inner letters cancel.  Metres, radians,
x forward, y left, yaw counter-clockwise (REP-103).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray


def wrap_angle(angle_rad: float) -> float:
    """The same angle in (-pi, pi]."""
    wrapped = math.remainder(angle_rad, math.tau)
    return math.pi if wrapped == -math.pi else wrapped


def wrap_angles(angles_rad: ArrayLike) -> NDArray[np.float64]:
    """`wrap_angle` for arrays of any shape: values in [-pi, pi)."""
    return (np.asarray(angles_rad, dtype=np.float64) + math.pi) % math.tau - math.pi


@dataclass(frozen=True, slots=True)
class SE2:
    """A rigid motion of the plane; as a pose, where one frame sits in another."""

    x_m: float
    y_m: float
    theta_rad: float

    @staticmethod
    def identity() -> SE2:
        return SE2(0.0, 0.0, 0.0)

    def __matmul__(self, other: SE2) -> SE2:
        c, s = math.cos(self.theta_rad), math.sin(self.theta_rad)
        return SE2(
            self.x_m + c * other.x_m - s * other.y_m,
            self.y_m + s * other.x_m + c * other.y_m,
            wrap_angle(self.theta_rad + other.theta_rad),
        )

    def inverse(self) -> SE2:
        c, s = math.cos(self.theta_rad), math.sin(self.theta_rad)
        return SE2(-c * self.x_m - s * self.y_m, s * self.x_m - c * self.y_m, wrap_angle(-self.theta_rad))

    def apply(self, points_m: ArrayLike) -> NDArray[np.float64]:
        """(N, 2) points of the inner frame, taken to the outer frame."""
        return np.asarray(points_m, dtype=np.float64) @ self.rotation().T + (self.x_m, self.y_m)

    def rotation(self) -> NDArray[np.float64]:
        c, s = math.cos(self.theta_rad), math.sin(self.theta_rad)
        return np.array([[c, -s], [s, c]])

    def matrix(self) -> NDArray[np.float64]:
        """(3, 3) homogeneous matrix."""
        c, s = math.cos(self.theta_rad), math.sin(self.theta_rad)
        return np.array([[c, -s, self.x_m], [s, c, self.y_m], [0.0, 0.0, 1.0]])

    def is_finite(self) -> bool:
        return math.isfinite(self.x_m) and math.isfinite(self.y_m) and math.isfinite(self.theta_rad)

    def distance_m(self, other: SE2) -> float:
        """Distance between the two origins."""
        return math.hypot(self.x_m - other.x_m, self.y_m - other.y_m)
