"""The ROS 2 messages we export, as CDR bytes, and their definitions as MCAP wants them.

CDR, little-endian: a header 00 01 00 00, then every number aligned to its own size, counted from behind the header; a string is
its length with the final NUL, its bytes, and the NUL; a sequence is its length and its elements.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence

import numpy as np

from protocol.geometry import SE2
from protocol.grid import OccupancyGrid

_RULE = "\n" + "=" * 80 + "\n"
_TIME = "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec"
_HEADER = "MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id"
_POINT = "MSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z"
_VECTOR = "MSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z"
_QUATERNION = "MSG: geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w"
_POSE = "MSG: geometry_msgs/Pose\ngeometry_msgs/Point position\ngeometry_msgs/Quaternion orientation"
_POSE_STAMPED = "MSG: geometry_msgs/PoseStamped\nstd_msgs/Header header\ngeometry_msgs/Pose pose"
_TRANSFORM = "MSG: geometry_msgs/Transform\ngeometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation"
_STAMPED = "MSG: geometry_msgs/TransformStamped\nstd_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform"
_META = (
    "MSG: nav_msgs/MapMetaData\nbuiltin_interfaces/Time map_load_time\nfloat32 resolution\nuint32 width\nuint32 height\n"
    "geometry_msgs/Pose origin"
)

OCCUPANCY_GRID, PATH, TF = "nav_msgs/msg/OccupancyGrid", "nav_msgs/msg/Path", "tf2_msgs/msg/TFMessage"
DEFINITIONS = {
    OCCUPANCY_GRID: _RULE.join(
        ["std_msgs/Header header\nnav_msgs/MapMetaData info\nint8[] data", _HEADER, _META, _TIME, _POSE, _POINT, _QUATERNION]
    ),
    PATH: _RULE.join(
        ["std_msgs/Header header\ngeometry_msgs/PoseStamped[] poses", _HEADER, _TIME, _POSE_STAMPED, _POSE, _POINT, _QUATERNION]
    ),
    TF: _RULE.join(["geometry_msgs/TransformStamped[] transforms", _STAMPED, _HEADER, _TIME, _TRANSFORM, _VECTOR, _QUATERNION]),
}


def occupancy_grid(grid: OccupancyGrid, stamp_s: float, frame: str) -> bytes:
    cdr = _Cdr().header(stamp_s, frame).time(stamp_s)
    cdr.number("f", grid.resolution_m).number("I", grid.width).number("I", grid.height).pose(grid.origin)
    cdr.number("I", grid.cells.size).raw(np.ascontiguousarray(grid.cells).tobytes())
    return bytes(cdr.data)


def path(stamps_s: Sequence[float], poses: Sequence[SE2], frame: str) -> bytes:
    cdr = _Cdr().header(stamps_s[-1] if stamps_s else 0.0, frame).number("I", len(poses))
    for stamp_s, pose in zip(stamps_s, poses, strict=True):
        cdr.header(stamp_s, frame).pose(pose)
    return bytes(cdr.data)


def transforms(stamp_s: float, links: Sequence[tuple[str, str, SE2]]) -> bytes:
    """(parent, child, T_parent_child)."""
    cdr = _Cdr().number("I", len(links))
    for parent, child, T_parent_child in links:
        cdr.header(stamp_s, parent).string(child).pose(T_parent_child)
    return bytes(cdr.data)


def nanoseconds(stamp_s: float) -> int:
    """Whole seconds apart from the rest: today's date in nanoseconds is more than a float holds to the last digit."""
    whole, rest = divmod(max(0.0, stamp_s), 1.0)
    return int(whole) * 1_000_000_000 + round(rest * 1e9)


class _Cdr:
    """Bytes that grow; every method returns the writer."""

    def __init__(self) -> None:
        self.data = bytearray(b"\x00\x01\x00\x00")

    def number(self, code: str, value: float) -> _Cdr:
        size = struct.calcsize(code)
        self.data += bytes(-(len(self.data) - 4) % size) + struct.pack(f"<{code}", value)
        return self

    def raw(self, data: bytes) -> _Cdr:
        self.data += data
        return self

    def string(self, text: str) -> _Cdr:
        data = text.encode() + b"\0"
        return self.number("I", len(data)).raw(data)

    def time(self, stamp_s: float) -> _Cdr:
        whole, rest = divmod(nanoseconds(stamp_s), 1_000_000_000)
        return self.number("i", whole).number("I", rest)

    def header(self, stamp_s: float, frame: str) -> _Cdr:
        return self.time(stamp_s).string(frame)

    def pose(self, pose: SE2) -> _Cdr:
        """Point and quaternion; Vector3 and quaternion lie the same."""
        half = pose.theta_rad / 2
        for value in (pose.x_m, pose.y_m, 0.0, 0.0, 0.0, math.sin(half), math.cos(half)):
            self.number("d", value)
        return self
