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

from agent.bag_frames import FrameTree
from agent.exits import ENVIRONMENT, CommandError
from agent.recordings import Readings, RecordingError, in_order, open_recording
from agent.rosbags_reader import laser_scan, odometry_reading
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
    assert scan is not None
    assert np.array_equal(scan.ranges_m, np.array([np.nan, 1.0, np.inf, np.nan, np.inf], np.float32), equal_nan=True)
    assert scan.angles_rad.tolist() == [1.0, 0.5, 0.0, -0.5, -1.0]
    assert (scan.stamp_s, scan.range_min_m, scan.range_max_m, scan.duration_s) == (7.0, 0.1, 30.0, 0.04)


@pytest.mark.parametrize(
    ("change", "seen"),
    [
        ({"range_min": 0.0}, [math.nan, 2.0, 5.0, 0.0]),  # a beam of 0 m is none, whatever the driver calls its least
        ({"range_max": 0.0}, [math.nan, 2.0, 5.0, 0.0]),  # a driver that says no range
        ({"time_increment": 5.0}, [math.nan, 2.0, 5.0, 0.0]),  # a unit that is none: not a sweep of fifteen seconds
        ({"range_max": 4.0, "time_increment": 0.1}, [math.nan, 2.0, math.inf, 0.3]),
        ({"angle_increment": 0.0}, None),
        ({"angle_min": math.nan}, None),
        ({"ranges": np.zeros(0)}, None),
    ],
)
def test_drivers_that_fill_in_half_of_a_scan(change: dict[str, object], seen: list[float] | None) -> None:
    whole = {
        "ranges": np.array([0.0, 2.0, 5.0, 5.0]), "angle_min": 0.0, "angle_increment": 0.1, "range_min": 0.1, "range_max": 30.0,
        "time_increment": 0.0,
    }  # fmt: skip
    scan = laser_scan(Message(**(whole | change)), 0.0)
    assert (scan is None) == (seen is None)
    if scan is not None and seen is not None:
        assert [*scan.ranges_m[:3].tolist(), scan.duration_s] == pytest.approx(seen, nan_ok=True)


def test_a_ros_odometry_becomes_ours() -> None:
    quarter = Message(x=0.0, y=0.0, z=math.sin(math.pi / 4), w=math.cos(math.pi / 4))
    reading = odometry_reading(Message(position=Message(x=1.0, y=2.0, z=0.0), orientation=quarter), 3.0)
    assert (reading.stamp_s, reading.x_m, reading.y_m) == (3.0, 1.0, 2.0)
    assert reading.theta_rad == pytest.approx(math.pi / 2)


def frames(*links: tuple[str, str, float, tuple[float, float]]) -> Message:
    """A TFMessage of (parent, child, x, (quaternion's x, z)) with the rest of the turn in w or nowhere."""
    return Message(
        transforms=[
            Message(
                header=Message(frame_id=parent),
                child_frame_id=child,
                transform=Message(
                    translation=Message(x=x, y=0.0, z=0.3),
                    rotation=Message(x=turn[0], y=0.0, z=turn[1], w=math.sqrt(max(0.0, 1 - turn[0] ** 2 - turn[1] ** 2))),
                ),
            )
            for parent, child, x, turn in links
        ]
    )


def test_the_lidar_is_found_through_the_tree_of_frames() -> None:
    tree = FrameTree("base_footprint", "laser")
    tree.add(frames(("base_footprint", "base_link", 0.0, (0.0, 0.0)), ("/base_link", "mast", 0.2, (0.0, 1.0))))
    assert not tree.is_found
    tree.add(frames(("mast", "/laser", 0.1, (0.0, 0.0)), ("odom", "base_footprint", 7.0, (0.0, 0.0))))
    T = tree.T_base_laser()
    assert T is not None
    assert (T.x_m, T.y_m) == pytest.approx((0.1, 0.0))
    assert abs(T.theta_rad) == pytest.approx(math.pi)
    assert not tree.is_upside_down()
    assert FrameTree("laser", "laser").T_base_laser() == SE2.identity()
    loop = FrameTree("x", "a")
    loop.add(frames(("b", "a", 0.0, (0.0, 0.0)), ("a", "b", 0.0, (0.0, 0.0))))
    assert loop.T_base_laser() is None


def test_a_trajectory_is_written_as_evo_reads_it() -> None:
    text = tum_text(np.array([[1.0, 2.0, 3.0, math.pi / 2], [0.5, 0, 0, 0], [1.0, 9, 9, 9]]), first_stamp_s=1e9)
    rows = [[float(word) for word in line.split(" ")] for line in text.splitlines()]
    assert [row[0] for row in rows] == [1e9 + 0.5, 1e9 + 1.0]
    assert rows[1][1:4] == [2.0, 3.0, 0.0]
    assert all(math.isclose(math.hypot(*row[4:]), 1.0, abs_tol=1e-6) for row in rows)


def test_without_rosbags_a_bag_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)  # as if it were not installed
    (tmp_path / "a.mcap").write_bytes(b"\x89MCAP0\r\n")
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


def test_a_lidar_that_hangs_and_a_robot_known_by_its_frames_alone(tmp_path: Path) -> None:
    recording = open_recording(write_bag(tmp_path / "bag", "mcap", hangs=True, has_odometry=False))
    assert [type(reading) for reading in recording.readings] == [Odometry, LaserScan] * 3
    assert [o.x_m for o in recording.readings if isinstance(o, Odometry)] == [0.0, 0.5, 1.0]
    scan = next(reading for reading in recording.readings if isinstance(reading, LaserScan))
    assert scan.angles_rad[1] == pytest.approx(-0.1)  # its beams run clockwise
    assert recording.T_base_laser == SE2(0.3, 0.0, 0.0)
    assert recording.odometry == "the frames in /tf"


def test_stamps_of_two_clocks_give_way_to_the_recorder_s(tmp_path: Path) -> None:
    recording = open_recording(write_bag(tmp_path / "bag", "sqlite3", odometry_ahead_s=5000))
    stamps = [reading.stamp_s for reading in recording.readings]
    assert stamps[-1] < 1e-3
    assert [type(reading) for reading in recording.readings] == [Odometry, LaserScan] * 3


@pytest.mark.parametrize("name", ["a.bag", "a.mcap", "a.db3"])
def test_what_is_no_bag_is_told_before_it_is_searched(name: str, tmp_path: Path) -> None:
    with (tmp_path / name).open("wb") as stream:
        stream.truncate(10 << 30)
    with pytest.raises(RecordingError, match=f"begins with .*, which is no {name[1:]} file"):
        open_recording(tmp_path / name)


def write_bag(folder: Path, storage: str, *, hangs: bool = False, has_odometry: bool = True, odometry_ahead_s: int = 0) -> Path:
    """Three scans with odometry, and where the LIDAR sits, by the library's own writer."""
    types = get_typestore(Stores.ROS2_HUMBLE)
    t = types.types
    point, quaternion, vector = t["geometry_msgs/msg/Point"], t["geometry_msgs/msg/Quaternion"], t["geometry_msgs/msg/Vector3"]
    header = lambda s, frame: t["std_msgs/msg/Header"](t["builtin_interfaces/msg/Time"](100 + int(s), round(s % 1 * 1e9)), frame)  # noqa: E731
    still = t["geometry_msgs/msg/TwistWithCovariance"](
        t["geometry_msgs/msg/Twist"](vector(0, 0, 0), vector(0, 0, 0)), np.zeros(36)
    )
    no_turn = quaternion(0.0, 0.0, 0.0, 1.0)
    with Writer(folder, version=8, storage_plugin=getattr(StoragePlugin, storage.upper())) as writer:
        topics = {
            kind: writer.add_connection(topic, kind, typestore=types)
            for topic, kind in (
                ("/scan", "sensor_msgs/msg/LaserScan"), ("/tf_static", "tf2_msgs/msg/TFMessage"),
                *([("/odom", "nav_msgs/msg/Odometry")] if has_odometry else []),
            )
        }  # fmt: skip
        topics["/tf"] = writer.add_connection("/tf", "tf2_msgs/msg/TFMessage", typestore=types)
        frame = lambda s, parent, child, x, q: t["tf2_msgs/msg/TFMessage"](  # noqa: E731
            [
                t["geometry_msgs/msg/TransformStamped"](
                    header(s, parent), child, t["geometry_msgs/msg/Transform"](vector(x, 0.0, 0.0), q)
                )
            ]
        )
        message = frame(0.0, "base_link", "laser", 0.3, quaternion(1.0, 0.0, 0.0, 0.0) if hangs else no_turn)
        writer.write(topics[message.__msgtype__], 0, types.serialize_cdr(message, message.__msgtype__))
        for i in range(3):
            pose = t["geometry_msgs/msg/PoseWithCovariance"](
                t["geometry_msgs/msg/Pose"](point(0.5 * i, 0.0, 0.0), no_turn), np.zeros(36)
            )
            beams = np.full(30, 2.0, np.float32)
            at_s = 0.1 * i + odometry_ahead_s
            for message in (
                t["nav_msgs/msg/Odometry"](header(at_s, "odom"), "base_link", pose, still)
                if has_odometry
                else frame(at_s, "odom", "base_link", 0.5 * i, no_turn),
                t["sensor_msgs/msg/LaserScan"](header(0.1 * i, "laser"), 0.0, 3.0, 0.1, 0.0, 0.1, 0.1, 30.0, beams, beams),
            ):
                topic = "/tf" if message.__msgtype__ == "tf2_msgs/msg/TFMessage" else message.__msgtype__
                writer.write(topics[topic], i + 1, types.serialize_cdr(message, message.__msgtype__))
    return folder
