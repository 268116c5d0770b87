"""The frames of a bag: where the LIDAR sits on the robot, and which way up, out of /tf_static and /tf.

A transform in /tf may move; the one from the odometry to the robot does, and is the motion of a bag without odometry
messages.  The way from the robot to the LIDAR goes through their nearest common ancestor, so a moving root does no harm.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.geometry import SE2

ODOM_FRAME = "odom"  # REP-105; perhaps below a robot's name


@dataclass(slots=True)
class FrameTree:
    """Child -> (parent, T_parent_child), and the two frames that matter once they are known."""

    base: str = ""
    laser: str = ""
    parents: dict[str, tuple[str, NDArray[np.float64]]] = field(default_factory=dict)  # (4, 4)

    def add(self, message: Any) -> None:
        """A tf2_msgs/TFMessage: the first transform of each frame counts."""
        for transform in message.transforms:
            self.parents.setdefault(
                named(transform.child_frame_id), (named(transform.header.frame_id), matrix(transform.transform))
            )

    def odometry(self, message: Any) -> Iterator[Any]:
        """The transforms that say where the robot is in its odometry frame."""
        for transform in message.transforms:
            if named(transform.header.frame_id).rsplit("/", 1)[-1] == ODOM_FRAME:
                self.base = self.base or named(transform.child_frame_id)
                if named(transform.child_frame_id) == named(self.base):
                    yield transform

    @property
    def is_found(self) -> bool:
        return bool(self.base and self.laser) and self.base_from_laser() is not None

    def base_from_laser(self) -> NDArray[np.float64] | None:
        """T_base_laser (4, 4) through their common ancestor; None when they have none."""
        ways = [dict(self._to_root(named(frame))) for frame in (self.base, self.laser)]
        for frame, T_frame_laser in ways[1].items():
            if frame in ways[0]:
                return np.asarray(np.linalg.inv(ways[0][frame]) @ T_frame_laser)
        return None

    def T_base_laser(self) -> SE2 | None:
        """On the floor, seen from above."""
        T = self.base_from_laser()
        return None if T is None else SE2(float(T[0, 3]), float(T[1, 3]), math.atan2(T[1, 0], T[0, 0]))

    def is_upside_down(self) -> bool:
        """Whether the LIDAR hangs from the robot, so that its beams run clockwise."""
        T = self.base_from_laser()
        return T is not None and bool(T[2, 2] < 0)

    def _to_root(self, frame: str) -> Iterator[tuple[str, NDArray[np.float64]]]:
        T_above_frame = np.eye(4)
        for _ in range(len(self.parents) + 1):  # a loop among the frames ends here
            yield frame, T_above_frame
            if frame not in self.parents:
                return
            frame, T_parent_child = self.parents[frame]
            T_above_frame = T_parent_child @ T_above_frame


def named(frame: str) -> str:
    """ROS 1 wrote a slash before it, sometimes."""
    return frame.removeprefix("/")


def matrix(transform: Any) -> NDArray[np.float64]:
    """(4, 4) of a geometry_msgs/Transform."""
    place, q = transform.translation, transform.rotation
    x, y, z, w = q.x, q.y, q.z, q.w
    T = np.eye(4)
    T[:3, 3] = place.x, place.y, place.z
    T[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return T


def yaw_rad(q: Any) -> float:
    """Of a quaternion."""
    return math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z))
