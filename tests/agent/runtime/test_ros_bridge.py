"""The ROS side, played by Zenoh: a router, and a subscriber that declares what rmw_zenoh declares and decodes with rosbags."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import numpy as np
import pytest
import zenoh
import zenoh.ext
from rosbags.typesys import Stores, get_typestore

from agent.config import Ros2Config
from agent.runtime.exchange import ExchangeError
from agent.runtime.ros_bridge import RosBridge, domain_of
from agent.xxh3 import xxh3_128
from protocol.geometry import SE2
from protocol.grid import OccupancyGrid
from tests.harness.waiting import until

STORE = get_typestore(Stores.ROS2_JAZZY)
GRID, TF = "nav_msgs/msg/OccupancyGrid", "tf2_msgs/msg/TFMessage"


class Fleet:
    """r1 and r-2, merged; the maps' versions grow when the test says so."""

    def __init__(self) -> None:
        self.version = 1

    def status(self) -> dict[str, Any]:
        maps = {name: {"version": str(self.version)} for name in ("global", "r1", "r-2")}
        frames, poses = {"r1": [0.0, 0.0, 0.0], "r-2": [4.0, 1.0, 0.5]}, {"r1": [1.0, 2.0, 0.25], "r-2": [0.5, 0.0, 0.0]}
        return {"robot": "r1", "frames": frames, "poses": poses, "odometry": None, "maps": maps}

    def grid(self, name: str) -> tuple[str, OccupancyGrid]:
        cells = np.full((20 * len(name), 30), -1, np.int8)
        cells[3, :] = 100
        cells[5, : self.version] = 0
        return str(self.version), OccupancyGrid(cells, 0.05, SE2(-1.0, -2.0, 0.0))


def session(mode: str, **more: Any) -> Any:
    config = {"mode": mode, "scouting": {"multicast": {"enabled": False}, "delay": 0}, "timestamping": {"enabled": True}, **more}
    return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))


@pytest.fixture
def router() -> Iterator[str]:
    """What rmw_zenohd is: its address."""
    with session("router", listen={"endpoints": ["tcp/127.0.0.1:0"]}, adminspace={"enabled": True}) as running:
        description = next(iter(running.get(f"@/{running.zid()}/router"))).ok.payload.to_bytes()
        yield json.loads(description)["locators"][0]


class RosNode:
    """A node of ROS: a peer of the router with subscriptions as rmw_subscription_data.cpp declares them."""

    def __init__(self, router: str, stack: ExitStack, domain: int = 0) -> None:
        endpoints = {"listen": {"endpoints": ["tcp/127.0.0.1:0"]}, "connect": {"endpoints": [router]}}
        self._session = stack.enter_context(session("peer", **endpoints))
        self._domain, self._stack = domain, stack
        self.graph: set[str] = set()  # the tokens that are there now, which is what `ros2 topic list` shows
        on_token = zenoh.handlers.Callback(self._on_token, indirect=False)
        self._session.liveliness().declare_subscriber(f"@ros2_lv/{domain}/**", on_token, history=True)

    def _on_token(self, sample: Any) -> None:
        change = self.graph.add if sample.kind == zenoh.SampleKind.PUT else self.graph.discard
        change(str(sample.key_expr))

    def subscribe(self, topic: str, kind: str, *, is_latched: bool) -> list[tuple[Any, bytes, str]]:
        """(message, attachment, key) of every sample, as they come."""
        came: list[tuple[Any, bytes, str]] = []
        package, name = kind.split("/msg/")
        key = f"{self._domain}{topic}/{package}::msg::dds_::{name}_/{STORE.hash_rihs01(kind)}"
        latched = {
            "history": zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1),
            "recovery": zenoh.ext.RecoveryConfig(heartbeat=True),
            "subscriber_detection": True,
        }

        def on_sample(sample: Any) -> None:
            message = STORE.deserialize_cdr(sample.payload.to_bytes(), kind)
            came.append((message, sample.attachment.to_bytes(), str(sample.key_expr)))

        on_sample_now = zenoh.handlers.Callback(on_sample, indirect=False)
        declare = zenoh.ext.declare_advanced_subscriber
        subscriber = declare(self._session, key, on_sample_now, **(latched if is_latched else {}))
        self._stack.callback(subscriber.undeclare)
        return came


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as held:
        yield held


def bridge(router: str, stack: ExitStack, fleet: Fleet, **settings: Any) -> RosBridge:
    return stack.enter_context(RosBridge(fleet, "r1", Ros2Config(enabled=True, connect=(router,), **settings), {}))


def test_who_comes_late_gets_the_last_map_and_then_every_new_one(router: str, stack: ExitStack) -> None:
    fleet = Fleet()
    bridge(router, stack, fleet)
    early = RosNode(router, stack).subscribe("/r_2/map", GRID, is_latched=True)
    until(lambda: early)
    late = RosNode(router, stack).subscribe("/global_map", GRID, is_latched=True)
    until(lambda: late)
    message = late[0][0]
    assert message.header.frame_id == "global"
    assert (message.info.width, message.info.height) == (30, 120)
    assert np.array_equal(message.data.reshape(120, 30), fleet.grid("global")[1].cells)
    assert (message.info.origin.position.x, message.info.origin.position.y) == (-1.0, -2.0)
    assert early[0][0].header.frame_id == "r_2/map"
    fleet.version = 2
    until(lambda: len(late) >= 2)
    assert int(np.count_nonzero(late[-1][0].data == 0)) == 2


def test_the_label_reads_as_rmw_zenoh_reads_it_and_names_the_publisher(router: str, stack: ExitStack) -> None:
    bridge(router, stack, Fleet(), domain=7)
    node = RosNode(router, stack, domain=7)
    came = node.subscribe("/tf", TF, is_latched=False)
    until(lambda: len(came) >= 2)
    until(lambda: len(node.graph) == 5)
    labels = [zenoh.ext.z_deserialize(tuple[zenoh.ext.Int64, zenoh.ext.Int64, bytes], zenoh.ZBytes(a)) for _, a, _ in came[:2]]
    assert int(labels[1][0]) - int(labels[0][0]) == 1
    assert abs(int(labels[0][1]) - time.time_ns()) < 60e9
    node_token, *publishers = sorted(node.graph, key=lambda token: "/NN/" not in token)
    assert node_token.endswith("/0/0/NN/%/%/mapquilt_r1")
    [tf] = [token for token in publishers if "/%tf/" in token]
    assert labels[0][2] == xxh3_128(tf.encode())
    assert {token.split("/")[9] for token in publishers} == {"%tf", "%global_map", "%r1%map", "%r_2%map"}
    assert all(token.split("/")[12] == ("::,100:,:,:,," if token == tf else ":1:,1:,:,:,,") for token in publishers)


def test_the_frames_are_a_tree_from_the_fleets_frame_to_every_robot(router: str, stack: ExitStack) -> None:
    bridge(router, stack, Fleet())
    came = RosNode(router, stack).subscribe("/tf", TF, is_latched=False)
    until(lambda: came)
    found = {link.child_frame_id: link for link in came[0][0].transforms}
    assert {child: link.header.frame_id for child, link in found.items()} == {
        "r1/map": "global", "r_2/map": "global", "r1/base_link": "r1/map", "r_2/base_link": "r_2/map",
    }  # fmt: skip
    moved = found["r_2/map"].transform
    assert (moved.translation.x, moved.translation.y, moved.rotation.z) == pytest.approx((4.0, 1.0, np.sin(0.25)))
    assert abs(found["r1/map"].header.stamp.sec - time.time()) < 60


def test_leaving_takes_the_node_out_of_the_graph(router: str, stack: ExitStack) -> None:
    node = RosNode(router, stack)
    with RosBridge(Fleet(), "r1", Ros2Config(connect=(router,)), {}):
        until(lambda: len(node.graph) == 5)
    until(lambda: not node.graph)


def test_without_a_router_the_robot_does_not_wait(stack: ExitStack) -> None:
    started = time.monotonic()
    bridge("tcp/127.0.0.1:9", stack, Fleet())
    stack.close()
    assert time.monotonic() - started < 3.0


def test_the_domain_is_the_settings_then_the_environments() -> None:
    assert domain_of(Ros2Config(domain=3), {"ROS_DOMAIN_ID": "5"}) == 3
    assert domain_of(Ros2Config(), {"ROS_DOMAIN_ID": "5"}) == 5
    assert domain_of(Ros2Config(), {}) == 0
    with pytest.raises(ExchangeError, match="ROS_DOMAIN_ID=five"):
        domain_of(Ros2Config(), {"ROS_DOMAIN_ID": "five"})
