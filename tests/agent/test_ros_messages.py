"""What goes to ROS: bytes equal to those of another serialiser, names and labels as rmw_zenoh's design document gives them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from agent.ros_frames import frame_links
from agent.ros_messages import OCCUPANCY_GRID, PATH, TF, occupancy_grid, path, transforms
from agent.ros_names import TYPE_HASHES, RosNode, Topic, label, ros_name
from agent.xxh3 import xxh3_128
from protocol.geometry import SE2
from protocol.grid import OccupancyGrid

STORE = get_typestore(Stores.ROS2_JAZZY)
T = STORE.types
STAMP_S = 1_793_000_000.25
POSES = [SE2(1.5, -2.25, 0.7), SE2(-3.0, 0.0, -math.pi / 2)]


def header(frame: str) -> Any:
    return T["std_msgs/msg/Header"](T["builtin_interfaces/msg/Time"](1_793_000_000, 250_000_000), frame)


def quaternion(pose: SE2) -> Any:
    return T["geometry_msgs/msg/Quaternion"](0.0, 0.0, math.sin(pose.theta_rad / 2), math.cos(pose.theta_rad / 2))


def ros_pose(pose: SE2) -> Any:
    return T["geometry_msgs/msg/Pose"](T["geometry_msgs/msg/Point"](pose.x_m, pose.y_m, 0.0), quaternion(pose))


@pytest.mark.parametrize("frame", ["", "map", "r1/map", "a_rather/long_name/map"])
@pytest.mark.parametrize(("rows", "columns"), [(1, 1), (3, 5), (40, 61)])
def test_a_grid_is_serialised_as_rosbags_does_it(rows: int, columns: int, frame: str) -> None:
    cells = np.random.default_rng(rows).choice(np.array([-1, 0, 100], np.int8), (rows, columns))
    grid = OccupancyGrid(cells, 0.05, POSES[0])
    info = T["nav_msgs/msg/MapMetaData"](header("").stamp, 0.05, columns, rows, ros_pose(POSES[0]))
    theirs = STORE.serialize_cdr(T[OCCUPANCY_GRID](header(frame), info, cells.ravel()), OCCUPANCY_GRID)
    assert occupancy_grid(grid, STAMP_S, frame) == bytes(theirs)


@pytest.mark.parametrize("names", [[], [("global", "r1/map")], [("global", "robot_12/map"), ("robot_12/map", "robot_12/odom")]])
def test_frames_are_serialised_as_rosbags_does_it(names: list[tuple[str, str]]) -> None:
    vector, stamped = T["geometry_msgs/msg/Vector3"], T["geometry_msgs/msg/TransformStamped"]
    links = [(parent, child, pose) for (parent, child), pose in zip(names, POSES, strict=False)]
    message = T[TF]([
        stamped(header(p), c, T["geometry_msgs/msg/Transform"](vector(pose.x_m, pose.y_m, 0.0), quaternion(pose)))
        for p, c, pose in links
    ])  # fmt: skip
    assert transforms(STAMP_S, links) == bytes(STORE.serialize_cdr(message, TF))


def test_a_path_is_serialised_as_rosbags_does_it() -> None:
    stamped = T["geometry_msgs/msg/PoseStamped"]
    message = T[PATH](header("r1/map"), [stamped(header("r1/map"), ros_pose(pose)) for pose in POSES])
    assert path([STAMP_S, STAMP_S], POSES, "r1/map") == bytes(STORE.serialize_cdr(message, PATH))


@pytest.mark.parametrize("store", [Stores.ROS2_IRON, Stores.ROS2_JAZZY, Stores.ROS2_KILTED, Stores.ROS2_LYRICAL])
def test_the_type_hashes_are_those_of_every_ros_since_iron(store: Stores) -> None:
    assert {kind: get_typestore(store).hash_rihs01(kind) for kind in TYPE_HASHES} == TYPE_HASHES


HASHES = {  # of bytes i * 7 + 3, by the package xxhash: low word, high word, little-endian
    17: "d7262a315476edee12bd2fcced27d3bf",
    32: "6252ade822fd61d745af6bab270f134f",
    97: "9e6122ecafd1178d3c621d780f2efe3f",
    128: "53ac926c8b0080c58bc7ba96a062191b",
    129: "5b384dce7ace91bd239061c468493e29",
    200: "bd3b84d5cd420138afbe18a9520a2032",
    240: "0be8be34f0b5e004c76b071b02c146ad",
    241: "17fe74883addea8b5db4d6c392346cac",
    1024: "b1721c641c66819b3636a3a9ac0ebc18",
    1025: "763571ed72206c807c8da9cf517244bf",
}


@pytest.mark.parametrize("length", HASHES)
def test_endpoints_are_named_by_xxh3(length: int) -> None:
    assert xxh3_128(bytes(i * 7 + 3 & 255 for i in range(length))).hex() == HASHES[length]


def test_a_publisher_is_named_as_rmw_zenoh_would() -> None:
    node = RosNode("talker", "8b20917502ee955ac4476e0266340d5c", domain=2)
    topic = Topic("/r1/map", OCCUPANCY_GRID)
    kind = f"nav_msgs::msg::dds_::OccupancyGrid_/{TYPE_HASHES[OCCUPANCY_GRID]}"
    assert node.token() == "@ros2_lv/2/8b20917502ee955ac4476e0266340d5c/0/0/NN/%/%/talker"
    assert node.data_key(topic) == f"2/r1/map/{kind}"
    start = "@ros2_lv/2/8b20917502ee955ac4476e0266340d5c/0/10/MP/%/%/talker"
    assert node.publisher_token(topic, 10) == f"{start}/%r1%map/{kind}/:1:,1:,:,:,,"
    assert node.publisher_token(Topic("/tf", TF, is_latched=False, depth=7), 10).endswith("/::,7:,:,:,,")
    humble = RosNode("n", "1", has_type_hashes=False)
    assert humble.data_key(topic) == "0/r1/map/nav_msgs::msg::dds_::OccupancyGrid_/TypeHashNotSupported"


def test_a_label_is_sequence_time_and_the_publishers_hash() -> None:
    data = label("x" * 200, 1, -2)
    assert len(data) == 33
    assert data[:17] == bytes.fromhex("0100000000000000feffffffffffffff10")
    assert data[17:] == xxh3_128(b"x" * 200)


def test_every_robot_gets_a_name_that_ros_allows_and_no_other_has() -> None:
    names: dict[str, str] = {}
    for robot in ("r1", "r-1", "r_1", "7up", "a--b", "a_"):
        names[robot] = ros_name(robot, names)
    assert list(names.values()) == ["r1", "r_1", "r_1_2", "robot_7up", "a_b", "a"]


def test_the_frames_make_one_tree_and_only_the_publisher_has_odometry() -> None:
    status = {
        "robot": "r1",
        "frames": {"r1": [0, 0, 0], "r2": [5, 0, 1]},
        "poses": {"r1": [1, 2, 0.5], "r2": [3, 0, 0]},
        "odometry": {"T_map_odom": [0.1, 0, 0], "T_odom_robot": [0.9, 2, 0.5]},
    }
    links = {child: (parent, pose) for parent, child, pose in frame_links(status, lambda robot: robot)}
    assert {child: parent for child, (parent, _) in links.items()} == {
        "r1/map": "global", "r2/map": "global", "r1/odom": "r1/map", "r1/base_link": "r1/odom", "r2/base_link": "r2/map",
    }  # fmt: skip
    assert links["r2/map"][1] == SE2(5, 0, 1)
    without = dict(status, odometry=None)
    assert ("r1/map", "r1/base_link", SE2(1, 2, 0.5)) in list(frame_links(without, lambda robot: robot))
