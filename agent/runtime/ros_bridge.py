"""ROS 2 without ROS: a session that speaks as an rmw_zenoh node, with the maps as latched topics and the frames as tf.

    /global_map      nav_msgs/OccupancyGrid, reliable + transient local, when it changed
    /<robot>/map     the same, for every map that is known here
    /tf              tf2_msgs/TFMessage, ten times a second (agent/ros_frames.py)

It reads what the page reads and writes nothing back.  Nothing else waits for it: a ROS graph that stalls, or is not there, costs
the robot nothing.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Mapping
from typing import Any, Protocol

from agent.config import Ros2Config
from agent.ros_frames import GLOBAL, frame_links, map_frame
from agent.ros_messages import OCCUPANCY_GRID, TF, occupancy_grid, transforms
from agent.ros_names import MAX_DOMAIN, RosNode, Topic, label, ros_name
from agent.runtime.announcer import Announcer
from agent.runtime.exchange import ExchangeError
from agent.runtime.worker import Worker
from protocol.grid import OccupancyGrid

log = logging.getLogger(__name__)

TF_PERIOD_S = 0.1  # nav2 wants a transform that is younger than 0.3 s
MAP_PERIOD_S = 1.0  # a map is looked at this often, and sent when it changed
TF_TOPIC = Topic("/tf", TF, is_latched=False, depth=100)
STOP_WITHIN_S = 1.0


class MapSource(Protocol):
    """What is published: a robot, or a watcher."""

    def status(self) -> Mapping[str, Any]: ...
    def grid(self, name: str) -> tuple[str, OccupancyGrid] | None: ...


class RosBridge:
    """Use with `with`: leaving takes the node out of the ROS graph."""

    def __init__(self, source: MapSource, robot: str, config: Ros2Config, environ: Mapping[str, str] = os.environ) -> None:
        self._source, self._config = source, config
        self._node_name, self._domain = f"mapquilt_{ros_name(robot, {})}", domain_of(config, environ)
        self._announcer = Announcer(ros_session(config.connect))
        self._node: RosNode | None = None
        self._topics: dict[str, _Publisher] = {}
        self._names: dict[str, str] = {}  # robot -> its name in ROS, never given to another
        self._versions: dict[str, str] = {}  # map -> version last sent
        self._next_maps_s = 0.0
        self._wait = threading.Event()
        self._worker = Worker("ros2", self._step, 60.0, "status, maps", "ROS 2 topics")

    def __enter__(self) -> RosBridge:
        self._announcer.open()
        self._node = RosNode(self._node_name, self._announcer.id, self._domain, self._config.distro != "humble")
        self._announcer.announce(self._node.token())
        self._worker.start()
        log.info("ros2 node=%s domain=%d router=%s", self._node_name, self._domain, ",".join(self._config.connect))
        return self

    def __exit__(self, *_: object) -> None:
        self._worker.ask_to_stop()
        self._wait.set()
        self._worker.join(STOP_WITHIN_S)
        self._announcer.close()

    def _step(self) -> None:
        if self._wait.wait(TF_PERIOD_S):
            return
        status = self._source.status()
        links = list(frame_links(status, self._name_of))
        if links:
            self._publisher(TF_TOPIC).put(transforms(time.time(), links))
        if time.monotonic() >= self._next_maps_s:
            self._next_maps_s = time.monotonic() + MAP_PERIOD_S
            for name, about in status["maps"].items():
                self._publish_map(name, about["version"])

    def _publish_map(self, name: str, version: str) -> None:
        if self._versions.get(name) == version:
            return
        found = self._source.grid(name)
        if found is None:
            return
        self._versions[name], grid = found
        ros = GLOBAL if name == GLOBAL else self._name_of(name)
        topic = Topic("/global_map" if name == GLOBAL else f"/{ros}/map", OCCUPANCY_GRID)
        self._publisher(topic).put(occupancy_grid(grid, time.time(), map_frame(ros)))

    def _name_of(self, robot: str) -> str:
        if robot not in self._names:
            self._names[robot] = ros_name(robot, self._names)
        return self._names[robot]

    def _publisher(self, topic: Topic) -> _Publisher:
        """The publisher of a topic, declared when the first message is there."""
        if topic.name not in self._topics:
            assert self._node is not None, "the bridge is open"
            self._topics[topic.name] = _Publisher(self._announcer, self._node, topic, len(self._topics) + 1)
        return self._topics[topic.name]


class _Publisher:
    """One topic of ours in the ROS graph."""

    def __init__(self, announcer: Announcer, node: RosNode, topic: Topic, entity: int) -> None:
        self._put = announcer.publisher(node.data_key(topic), topic.depth if topic.is_latched else 0)
        self._token = node.publisher_token(topic, entity)
        self._sequence = 0
        announcer.announce(self._token)

    def put(self, cdr: bytes) -> None:
        self._sequence += 1
        self._put(cdr, label(self._token, self._sequence, time.time_ns()))


def ros_session(connect: tuple[str, ...]) -> dict[str, Any]:
    """The session that rmw_zenoh's own defaults describe: a peer of the local router, found by gossip, never by multicast."""
    return {
        "mode": "peer",
        "connect": {"endpoints": list(connect)},
        "listen": {"endpoints": ["tcp/localhost:0"]},
        "scouting": {
            "multicast": {"enabled": False},
            "gossip": {"target": {"peer": ["router"]}, "autoconnect_strategy": {"peer": {"to_peer": "greater-zid"}}},
        },
        "timestamping": {"enabled": True},
        "transport": {"shared_memory": {"enabled": False}},
    }


def domain_of(config: Ros2Config, environ: Mapping[str, str]) -> int:
    """The one in the settings, else ROS_DOMAIN_ID, else 0."""
    if config.domain >= 0:
        return config.domain
    said = environ.get("ROS_DOMAIN_ID", "").strip() or "0"
    if not said.isdigit() or int(said) > MAX_DOMAIN:
        raise ExchangeError(f"ROS_DOMAIN_ID={said}: expected a number from 0 to {MAX_DOMAIN}; or say --set ros2.domain=0")
    return int(said)
