"""Recordings of other people's robots as readings: CARMEN logs, and bags through rosbags."""

from __future__ import annotations

import gzip
import itertools
import math
import sys
from pathlib import Path
from types import SimpleNamespace as Message

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from agent.exits import ENVIRONMENT, CommandError
from agent.recordings import Readings, RecordingError, in_order, open_recording
from agent.rosbags_reader import laser_scan, odometry_reading, transform_between
from agent.trajectory_files import tum_text
from hw.readings import LaserScan, Odometry
from protocol.geometry import SE2

CARMEN = """\
PARAM robot_frontlaser_offset 0.0
ODOM 0 0 0 0 0 0 0.0 host 0.0
FLASER 4 1.0 2.0 3.0 80.0 0 0 0 0 0 0 10.0 host 10.0
ODOM 0 0 0 0 0 0 0 host 0
ODOM 0.5 0 0.1 0 0 0 10.4 host 10.4
FLASER 4 1.1 2.1 3.1 4.1 0.45 0 0.09 0.45 0 0.09 10.5 host 10.5
ODOM 0.45 0 0.09 0 0 0 0 host 0
FLASER 4 1.1 2.1 3.1 4.1 0.85 0 0.09 0.85 0 0.09 10.4 host 10.4
FLASER 4 1.1 2.1 3.1 4.1 0.95 0 0.09 0.95 0 0.09 10.4 host 10.4
"""


def test_a_carmen_log_gives_odometry_before_every_scan(tmp_path: Path) -> None:
    log = tmp_path / "run.log.gz"
    log.write_bytes(gzip.compress(CARMEN.encode()))
    recording = open_recording(log)
    assert recording.name == "run"
    assert [type(reading) for reading in recording.readings] == [Odometry, LaserScan, Odometry] + [Odometry, LaserScan] * 3
    stamps = [reading.stamp_s for reading in recording.readings]
    assert stamps == sorted(stamps)
    odometry = [reading for reading in recording.readings if isinstance(reading, Odometry)]
    moved, unknown = odometry[2], odometry[-1]
    assert (moved.x_m, moved.theta_rad, moved.is_discontinuity) == (0.5, 0.1, False)
    assert unknown.is_discontinuity  # no ODOM between the last two scans: how the robot moved is not known


def test_stamps_that_repeat_or_go_back_are_put_in_order() -> None:
    ordered = in_order(Readings("x", [Odometry(s, 0, 0, 0) for s in (1.0, 1.0, 0.5, 2.0)])).readings
    stamps = [reading.stamp_s for reading in ordered]
    assert all(a < b for a, b in itertools.pairwise(stamps))
    assert stamps[0] == 1.0
    assert stamps[3] == 2.0


@pytest.mark.parametrize(
    ("name", "content"), [("none.log", None), ("empty.log", b""), ("text.clf", b"hello\n"), ("half.log.gz", b"\x1f\x8b\x08")]
)
def test_what_is_no_recording_is_told(name: str, content: bytes | None, tmp_path: Path) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(RecordingError, match=name):
        open_recording(tmp_path / name)


def test_a_ros_scan_becomes_ours() -> None:
    message = Message(
        ranges=np.array([0.01, 1.0, 50.0, np.nan, np.inf], np.float32), angle_min=1.0, angle_increment=-0.5, range_min=0.1,
        range_max=30.0, time_increment=0.01,
    )  # fmt: skip
    scan = laser_scan(message, 7.0)
    assert np.array_equal(scan.ranges_m, np.array([np.nan, 1.0, np.inf, np.nan, np.inf], np.float32), equal_nan=True)
    assert scan.angles_rad.tolist() == [1.0, 0.5, 0.0, -0.5, -1.0]
    assert (scan.stamp_s, scan.range_min_m, scan.range_max_m, scan.duration_s) == (7.0, 0.1, 30.0, 0.04)


def test_a_ros_odometry_becomes_ours() -> None:
    quarter = Message(x=0.0, y=0.0, z=math.sin(math.pi / 4), w=math.cos(math.pi / 4))
    message = Message(pose=Message(pose=Message(position=Message(x=1.0, y=2.0, z=0.0), orientation=quarter)))
    reading = odometry_reading(message, 3.0)
    assert (reading.stamp_s, reading.x_m, reading.y_m) == (3.0, 1.0, 2.0)
    assert reading.theta_rad == pytest.approx(math.pi / 2)


def test_the_lidar_is_found_through_the_tree_of_frames() -> None:
    tree = {
        "base_link": ("base_footprint", SE2(0.0, 0.0, 0.0)),
        "mast": ("base_link", SE2(0.2, 0.0, math.pi)),
        "laser": ("mast", SE2(0.1, 0.0, 0.0)),
    }
    T = transform_between(tree, "base_footprint", "laser")
    assert T is not None
    assert (T.x_m, T.y_m) == pytest.approx((0.1, 0.0))
    assert abs(T.theta_rad) == pytest.approx(math.pi)
    assert transform_between(tree, "laser", "laser") == SE2.identity()
    assert transform_between(tree, "odom", "laser") is None
    assert transform_between({"a": ("b", SE2.identity()), "b": ("a", SE2.identity())}, "x", "a") is None


def test_a_trajectory_is_written_as_evo_reads_it() -> None:
    text = tum_text(np.array([[1.0, 2.0, 3.0, math.pi / 2], [0.5, 0, 0, 0], [1.0, 9, 9, 9]]), first_stamp_s=1e9)
    rows = [[float(word) for word in line.split(" ")] for line in text.splitlines()]
    assert [row[0] for row in rows] == [1e9 + 0.5, 1e9 + 1.0]
    assert rows[1][1:4] == [2.0, 3.0, 0.0]
    assert all(math.isclose(math.hypot(*row[4:]), 1.0, abs_tol=1e-6) for row in rows)


def test_without_rosbags_a_bag_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)  # as if it were not installed
    (tmp_path / "a.mcap").touch()
    with pytest.raises(CommandError, match="pip install rosbags") as caught:
        open_recording(tmp_path / "a.mcap")
    assert caught.value.code == ENVIRONMENT


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize("is_bare", [False, True])
def test_a_bag_reads_back(storage: str, is_bare: bool, tmp_path: Path) -> None:
    written = write_bag(tmp_path / "bag", storage)
    path = next(path for path in written.iterdir() if path.suffix in (".mcap", ".db3")) if is_bare else written
    recording = open_recording(path)
    scans = [reading for reading in recording.readings if isinstance(reading, LaserScan)]
    odometry = [reading for reading in recording.readings if isinstance(reading, Odometry)]
    assert [scan.stamp_s for scan in scans] == pytest.approx([0.0, 0.1, 0.2], abs=1e-5)
    assert [o.x_m for o in odometry] == [0.0, 0.5, 1.0]
    assert recording.first_stamp_s == pytest.approx(100.0)
    assert recording.T_base_laser == SE2(0.3, 0.0, 0.0)
    with pytest.raises(RecordingError, match="no sensor_msgs/msg/LaserScan on /front; there is /scan"):
        open_recording(path, scan_topic="/front")


def write_bag(folder: Path, storage: str) -> Path:
    """Three scans with odometry, and where the LIDAR sits, by the library's own writer."""
    types = get_typestore(Stores.ROS2_HUMBLE)
    t = types.types
    point, quaternion, vector = t["geometry_msgs/msg/Point"], t["geometry_msgs/msg/Quaternion"], t["geometry_msgs/msg/Vector3"]
    header = lambda s, frame: t["std_msgs/msg/Header"](t["builtin_interfaces/msg/Time"](100, round(s * 1e9)), frame)  # noqa: E731
    still = t["geometry_msgs/msg/TwistWithCovariance"](
        t["geometry_msgs/msg/Twist"](vector(0, 0, 0), vector(0, 0, 0)), np.zeros(36)
    )
    no_turn = quaternion(0.0, 0.0, 0.0, 1.0)
    with Writer(folder, version=8, storage_plugin=getattr(StoragePlugin, storage.upper())) as writer:
        topics = {
            kind: writer.add_connection(topic, kind, typestore=types)
            for topic, kind in (
                ("/scan", "sensor_msgs/msg/LaserScan"), ("/odom", "nav_msgs/msg/Odometry"),
                ("/tf_static", "tf2_msgs/msg/TFMessage"),
            )
        }  # fmt: skip
        mount = t["geometry_msgs/msg/Transform"](vector(0.3, 0.0, 0.0), no_turn)
        stamped = t["geometry_msgs/msg/TransformStamped"](header(0.0, "base_link"), "laser", mount)
        message = t["tf2_msgs/msg/TFMessage"]([stamped])
        writer.write(topics[message.__msgtype__], 0, types.serialize_cdr(message, message.__msgtype__))
        for i in range(3):
            pose = t["geometry_msgs/msg/PoseWithCovariance"](
                t["geometry_msgs/msg/Pose"](point(0.5 * i, 0.0, 0.0), no_turn), np.zeros(36)
            )
            beams = np.full(30, 2.0, np.float32)
            for message in (
                t["nav_msgs/msg/Odometry"](header(0.1 * i, "odom"), "base_link", pose, still),
                t["sensor_msgs/msg/LaserScan"](header(0.1 * i, "laser"), 0.0, 3.0, 0.1, 0.0, 0.1, 0.1, 30.0, beams, beams),
            ):
                writer.write(topics[message.__msgtype__], i + 1, types.serialize_cdr(message, message.__msgtype__))
    return folder
