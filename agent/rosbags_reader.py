"""rosbag2 directories, bare MCAP and db3 files, and ROS 1 bags as readings, through the optional package `rosbags`.

The LIDAR's place on the robot comes from /tf_static, when the bag has it.  No ROS is needed.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from agent.exits import ENVIRONMENT, CommandError
from agent.recordings import Readings, RecordingError
from hw.readings import LaserScan, Odometry
from protocol.geometry import SE2

SCAN, ODOMETRY, TF = "sensor_msgs/msg/LaserScan", "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage"
MAX_BEAMS = 100_000


def read_bag(path: Path, scan_topic: str | None = None, odometry_topic: str | None = None) -> Readings:
    """Scans and odometry of a bag, sorted by their own stamps, which start at 0."""
    try:
        from rosbags.highlevel import AnyReader  # noqa: PLC0415  optional
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415
    except ImportError as error:
        raise CommandError(
            f"{path}: reading bags needs the package rosbags: {sys.executable} -m pip install rosbags", ENVIRONMENT
        ) from error
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            return _readings(path.name, reader, scan_topic, odometry_topic)
    except FileNotFoundError as error:
        raise RecordingError(f"{path}: no such recording (a rosbag2 directory holds a metadata.yaml)") from error
    except RecordingError:
        raise
    except Exception as error:  # the library raises many kinds for files that are none of its own
        raise RecordingError(f"{path}: cannot be read as a bag: {error}") from error


def _readings(name: str, reader: Any, scan_topic: str | None, odometry_topic: str | None) -> Readings:
    scans = _topic(name, reader, SCAN, scan_topic, "--scan-topic")
    odometry = _topic(name, reader, ODOMETRY, odometry_topic, "--odom-topic", is_needed=False)
    chosen = [c for c in reader.connections if c.topic in (scans, odometry) or c.msgtype == TF]
    readings: list[LaserScan | Odometry] = []
    transforms: dict[str, tuple[str, SE2]] = {}
    frames = ["", ""]
    for connection, bag_ns, raw in reader.messages(connections=chosen):
        message = reader.deserialize(raw, connection.msgtype)
        if connection.msgtype == TF:
            if connection.topic.endswith("tf_static"):
                transforms.update(_static_transforms(message))
        elif connection.msgtype == SCAN:
            frames[1] = frames[1] or message.header.frame_id
            readings.append(laser_scan(message, _stamp_s(message, bag_ns)))
        else:
            frames[0] = frames[0] or message.child_frame_id
            readings.append(odometry_reading(message, _stamp_s(message, bag_ns)))
    if not any(isinstance(reading, LaserScan) for reading in readings):
        raise RecordingError(f"{name}: no scan on {scans}")
    readings.sort(key=lambda reading: (reading.stamp_s, isinstance(reading, LaserScan)))
    first_s = readings[0].stamp_s
    return Readings(name, list(_shifted(readings, first_s)), first_s, transform_between(transforms, *frames))


def _topic(name: str, reader: Any, kind: str, asked: str | None, flag: str, *, is_needed: bool = True) -> str | None:
    """The topic of a kind: the one asked for, the only one, or an error that lists them."""
    there = sorted({c.topic for c in reader.connections if c.msgtype == kind})
    if asked is not None:
        if asked not in there:
            raise RecordingError(f"{name}: no {kind} on {asked}; there is {', '.join(there) or 'none at all'}")
        return asked
    if len(there) > 1:
        raise RecordingError(f"{name}: several {kind} topics; choose one with {flag}: {', '.join(there)}")
    if not there and is_needed:
        raise RecordingError(
            f"{name}: no {kind} in it; its topics are {', '.join(sorted({c.topic for c in reader.connections}))}"
        )
    return there[0] if there else None


def laser_scan(message: Any, stamp_s: float) -> LaserScan:
    """sensor_msgs/LaserScan by REP-117; the rays of a clockwise scanner come with falling angles."""
    ranges_m = np.array(message.ranges[:MAX_BEAMS], np.float32)
    angles_rad = message.angle_min + message.angle_increment * np.arange(len(ranges_m))
    low_m, high_m = float(message.range_min), float(message.range_max)
    with np.errstate(invalid="ignore"):
        ranges_m[ranges_m < low_m] = np.nan
        ranges_m[ranges_m > high_m] = np.inf
    duration_s = max(0.0, float(message.time_increment) * (len(ranges_m) - 1))
    return LaserScan(stamp_s, ranges_m, angles_rad.astype(np.float32), low_m, high_m, duration_s)


def odometry_reading(message: Any, stamp_s: float) -> Odometry:
    pose = message.pose.pose
    return Odometry(stamp_s, float(pose.position.x), float(pose.position.y), _yaw_rad(pose.orientation))


def transform_between(transforms: dict[str, tuple[str, SE2]], base: str, laser: str) -> SE2 | None:
    """T_base_laser out of child -> (parent, T_parent_child), through their common ancestor; None when they have none."""
    ways = [dict(_to_root(transforms, frame)) for frame in (base, laser)]
    for frame, T_frame_laser in ways[1].items():
        if frame in ways[0]:
            return ways[0][frame].inverse() @ T_frame_laser
    return None


def _to_root(transforms: dict[str, tuple[str, SE2]], frame: str) -> Iterator[tuple[str, SE2]]:
    T_above_frame = SE2.identity()
    for _ in range(len(transforms) + 1):  # a loop among the frames ends here
        yield frame, T_above_frame
        if frame not in transforms:
            return
        frame, T_parent_child = transforms[frame]
        T_above_frame = T_parent_child @ T_above_frame


def _static_transforms(message: Any) -> Iterator[tuple[str, tuple[str, SE2]]]:
    for transform in message.transforms:
        place, turn = transform.transform.translation, transform.transform.rotation
        T_parent_child = SE2(float(place.x), float(place.y), _yaw_rad(turn))
        yield transform.child_frame_id, (transform.header.frame_id, T_parent_child)


def _yaw_rad(q: Any) -> float:
    return math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z))


def _stamp_s(message: Any, bag_ns: int) -> float:
    stamp = message.header.stamp
    return stamp.sec + stamp.nanosec * 1e-9 if stamp.sec or stamp.nanosec else bag_ns * 1e-9


def _shifted(readings: list[LaserScan | Odometry], first_s: float) -> Iterator[LaserScan | Odometry]:
    for reading in readings:
        yield replace(reading, stamp_s=reading.stamp_s - first_s)
