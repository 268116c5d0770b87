"""rosbag2 directories, bare MCAP and db3 files, and ROS 1 bags as readings, through the optional package `rosbags`.

The LIDAR's place on the robot comes from /tf_static or /tf, when the bag has it (agent/bag_frames.py); of a bag without odometry
messages the motion comes from /tf.  No ROS is needed.
"""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from agent.bag_frames import FrameTree, yaw_rad
from agent.exits import ENVIRONMENT, CommandError
from agent.recordings import Readings, RecordingError
from hw.readings import LaserScan, Odometry

SCAN, ODOMETRY = "sensor_msgs/msg/LaserScan", "nav_msgs/msg/Odometry"
TF = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
MAGIC = {".mcap": b"\x89MCAP0\r\n", ".db3": b"SQLite format 3\0", ".bag": b"#ROSBAG V2.0\n"}
MAX_BEAMS = 100_000
SLOWEST_S = 1.0  # a revolution; time increments that make more of it are none
FARTHEST_M = 100.0  # when the driver says none


def read_bag(path: Path, scan_topic: str | None = None, odometry_topic: str | None = None) -> Readings:
    """Scans and odometry of a bag, sorted by their own stamps, which start at 0."""
    _check_magic(path)
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


def _check_magic(path: Path) -> None:
    """What is no bag is told before the library reads on in search of one."""
    expected = MAGIC.get(path.suffix, b"") if path.is_file() else b""
    try:
        with path.open("rb") if expected else BytesIO() as stream:
            head = stream.read(len(expected))
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror or error}") from error
    if head != expected:
        seen = f"begins with {head!r}" if head else "is empty"
        raise RecordingError(f"{path}: {seen}, which is no {path.suffix} file; was it copied whole?")


def _readings(name: str, reader: Any, scan_topic: str | None, odometry_topic: str | None) -> Readings:
    scans = _topic(name, reader, SCAN, scan_topic, "--scan-topic")
    odometry = _topic(name, reader, ODOMETRY, odometry_topic, "--odom-topic", is_needed=False)
    chosen = [c for c in reader.connections if c.topic in (scans, odometry) or c.msgtype in TF]
    timed: list[tuple[LaserScan | Odometry, float]] = []  # and when it was written
    tree = FrameTree()
    for connection, bag_ns, raw in reader.messages(connections=chosen):
        if connection.msgtype in TF and odometry is not None and tree.is_found and not connection.topic.endswith("tf_static"):
            continue
        message = reader.deserialize(raw, connection.msgtype)
        if connection.msgtype in TF:
            tree.add(message)
            moves = tree.odometry(message) if odometry is None else ()
            timed += [(odometry_reading(move.transform, _stamp_s(move, bag_ns)), bag_ns * 1e-9) for move in moves]
        elif connection.msgtype == SCAN:
            tree.laser = tree.laser or message.header.frame_id
            scan = laser_scan(message, _stamp_s(message, bag_ns))
            timed += [(scan, bag_ns * 1e-9)] if scan is not None else []
        else:
            tree.base = tree.base or message.child_frame_id
            timed.append((odometry_reading(message.pose.pose, _stamp_s(message, bag_ns)), bag_ns * 1e-9))
    if not any(isinstance(reading, LaserScan) for reading, _ in timed):
        raise RecordingError(f"{name}: no scan with beams on {scans}")
    readings = sorted(_on_one_clock(timed), key=lambda reading: (reading.stamp_s, isinstance(reading, LaserScan)))
    first_s, T_base_laser = readings[0].stamp_s, tree.T_base_laser()
    shifted = [replace(reading, stamp_s=reading.stamp_s - first_s) for reading in readings]
    if tree.is_upside_down():
        shifted = [replace(r, angles_rad=-r.angles_rad) if isinstance(r, LaserScan) else r for r in shifted]
    source = odometry or ("the frames in /tf" if len(readings) > sum(isinstance(r, LaserScan) for r in readings) else "none")
    return Readings(name, shifted, first_s, T_base_laser, source)


def _on_one_clock(timed: list[tuple[LaserScan | Odometry, float]]) -> list[LaserScan | Odometry]:
    """By their own stamps; when those of scans and odometry have no moment in common (one clock is simulated), as written."""
    spans = [[r.stamp_s for r, _ in timed if isinstance(r, kind)] for kind in (LaserScan, Odometry)]
    if not spans[1] or (min(spans[0]) <= max(spans[1]) and min(spans[1]) <= max(spans[0])):
        return [reading for reading, _ in timed]
    return [replace(reading, stamp_s=written_s) for reading, written_s in timed]


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


def laser_scan(message: Any, stamp_s: float) -> LaserScan | None:
    """sensor_msgs/LaserScan by REP-117; the rays of a clockwise scanner come with falling angles.  None when it has no rays."""
    ranges_m = np.array(message.ranges[:MAX_BEAMS], np.float32)
    angles_rad = message.angle_min + message.angle_increment * np.arange(len(ranges_m))
    if len(ranges_m) < 2 or message.angle_increment == 0 or not np.isfinite(angles_rad).all():
        return None
    low_m, high_m = float(message.range_min), float(message.range_max)
    high_m = high_m if math.isfinite(high_m) and high_m > max(low_m, 0.0) else FARTHEST_M
    with np.errstate(invalid="ignore"):
        ranges_m[(ranges_m < low_m) | (ranges_m <= 0)] = np.nan
        ranges_m[ranges_m > high_m] = np.inf
    duration_s = max(0.0, float(message.time_increment) * (len(ranges_m) - 1))
    is_sweep = duration_s <= SLOWEST_S
    return LaserScan(stamp_s, ranges_m, angles_rad.astype(np.float32), low_m, high_m, duration_s if is_sweep else 0.0)


def odometry_reading(pose: Any, stamp_s: float) -> Odometry:
    """A geometry_msgs/Pose, or a Transform."""
    place, turn = (pose.position, pose.orientation) if hasattr(pose, "position") else (pose.translation, pose.rotation)
    return Odometry(stamp_s, float(place.x), float(place.y), yaw_rad(turn))


def _stamp_s(message: Any, bag_ns: int) -> float:
    stamp = message.header.stamp
    return stamp.sec + stamp.nanosec * 1e-9 if stamp.sec or stamp.nanosec else bag_ns * 1e-9
