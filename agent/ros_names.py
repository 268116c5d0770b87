"""How rmw_zenoh, ROS 2's Zenoh middleware, names what it carries: keys, liveliness tokens, and the label on every sample.

    data      <domain>/<topic>/<type>/<type hash>
    node      @ros2_lv/<domain>/<session>/0/0/NN/%/%/<node>
    publisher @ros2_lv/<domain>/<session>/0/<entity>/MP/%/%/<node>/%<topic>/<type>/<type hash>/<qos>     (a name with % for /)
    label     int64 sequence | int64 nanoseconds | 16 | 16 bytes: the hash of the publisher's token           little-endian

A subscriber sees what carries its own type's hash and nothing else; a label of another form ends the ROS node that reads it.
Source: docs/design.md of ros2/rmw_zenoh.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping
from dataclasses import dataclass

from agent.ros_messages import OCCUPANCY_GRID, TF
from agent.xxh3 import xxh3_128

TYPE_HASHES = {  # REP-2016, the same from Iron to Kilted; tests compute them anew
    OCCUPANCY_GRID: "RIHS01_8d348150c12913a31ee0ec170fbf25089e4745d17035792a1ba94d6f0bc0cfc7",
    TF: "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
}
NO_TYPE_HASH = "TypeHashNotSupported"  # what Humble, which knows no hashes, writes instead
MAX_DOMAIN = 232  # ROS_DOMAIN_ID on Linux


@dataclass(frozen=True, slots=True)
class Topic:
    """What is published where; the name begins with a slash."""

    name: str
    kind: str  # nav_msgs/msg/OccupancyGrid
    is_latched: bool = True  # reliable, transient local, the last one kept; else reliable, volatile, the last `depth`
    depth: int = 1

    @property
    def qos(self) -> str:
        """reliability:durability:history,depth:deadline:lifespan:liveliness; what is the default stays empty."""
        return f":{'1' if self.is_latched else ''}:,{self.depth}:,:,:,,"


@dataclass(frozen=True, slots=True)
class RosNode:
    """One node of a ROS graph, made by one Zenoh session."""

    name: str
    session: str  # the session's id in hexadecimal
    domain: int = 0
    has_type_hashes: bool = True

    def token(self) -> str:
        return f"{self._start(0)}/NN/%/%/{self.name}"

    def publisher_token(self, topic: Topic, entity: int) -> str:
        return f"{self._start(entity)}/MP/%/%/{self.name}/{topic.name.replace('/', '%')}/{self._type(topic)}/{topic.qos}"

    def data_key(self, topic: Topic) -> str:
        return f"{self.domain}{topic.name}/{self._type(topic)}"

    def _start(self, entity: int) -> str:
        return f"@ros2_lv/{self.domain}/{self.session}/0/{entity}"

    def _type(self, topic: Topic) -> str:
        package, _, name = topic.kind.partition("/msg/")
        return f"{package}::msg::dds_::{name}_/{TYPE_HASHES[topic.kind] if self.has_type_hashes else NO_TYPE_HASH}"


def label(token: str, sequence: int, stamp_ns: int) -> bytes:
    """The attachment of a publisher's sample; sequences start at 1."""
    return struct.pack("<qqB", sequence, stamp_ns, 16) + xxh3_128(token.encode())


def ros_name(robot: str, taken: Mapping[str, str]) -> str:
    """A robot's id as a ROS name, unlike those `taken`: letters, digits and single underscores, beginning with a letter."""
    plain = re.sub(r"[^a-z0-9]+", "_", robot).strip("_") or "robot"
    plain = plain if plain[0].isalpha() else f"robot_{plain}"
    name, number = plain, 1
    while name in taken.values():
        number += 1
        name = f"{plain}_{number}"
    return name
