"""MCAP files that Foxglove, rosbag2 and PlotJuggler open: ROS 2 messages in CDR, without ROS.

89 'MCAP0' 0D 0A | records (opcode u8, length u64, content) ... | the same magic             little-endian throughout
Header 01   Schema 03   Channel 04   Message 05   Data End 0F   | summary: Schema, Channel, Statistics 0B | Footer 02

mcap = McapFile(); mcap.add("/r1/map", "nav_msgs/msg/OccupancyGrid", stamp_s, occupancy_grid(...)); mcap.encoded()
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field

from agent.ros_messages import DEFINITIONS, nanoseconds

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, STATISTICS, DATA_END = 0x01, 0x02, 0x03, 0x04, 0x05, 0x0B, 0x0F
LIBRARY = "mapquilt"


@dataclass(slots=True)
class McapFile:
    """Messages in the order of their time; small files of ours, so nothing is chunked or compressed."""

    _schemas: dict[str, int] = field(default_factory=dict)  # type -> id, from 1
    _channels: dict[str, tuple[int, str]] = field(default_factory=dict)  # topic -> (id, type)
    _messages: list[tuple[int, int, bytes]] = field(default_factory=list)  # (ns, channel, CDR)

    def add(self, topic: str, kind: str, stamp_s: float, cdr: bytes) -> None:
        self._schemas.setdefault(kind, len(self._schemas) + 1)
        channel, known_kind = self._channels.setdefault(topic, (len(self._channels), kind))
        assert known_kind == kind, "a topic has one type"
        self._messages.append((nanoseconds(stamp_s), channel, cdr))

    def encoded(self) -> bytes:
        """The whole file."""
        definitions = self._definitions()
        data = [MAGIC, _record(HEADER, _string("ros2") + _string(LIBRARY)), definitions]
        messages = sorted(self._messages, key=lambda message: message[0])
        for sequence, (at_ns, channel, cdr) in enumerate(messages):
            data.append(_record(MESSAGE, struct.pack("<HIQQ", channel, sequence, at_ns, at_ns) + cdr))
        data.append(_record(DATA_END, struct.pack("<I", 0)))
        summary_start = sum(map(len, data))
        footer = _record(FOOTER, struct.pack("<QQI", summary_start, 0, 0))
        return b"".join([*data, definitions, self._statistics(messages), footer, MAGIC])

    def _definitions(self) -> bytes:
        records = []
        for kind, number in self._schemas.items():
            text = DEFINITIONS[kind].encode()
            content = struct.pack("<H", number) + _string(kind) + _string("ros2msg") + struct.pack("<I", len(text)) + text
            records.append(_record(SCHEMA, content))
        for topic, (number, kind) in self._channels.items():
            content = struct.pack("<HH", number, self._schemas[kind]) + _string(topic) + _string("cdr") + struct.pack("<I", 0)
            records.append(_record(CHANNEL, content))
        return b"".join(records)

    def _statistics(self, messages: list[tuple[int, int, bytes]]) -> bytes:
        counts = [sum(channel == number for _, channel, _ in messages) for number, _ in self._channels.values()]
        first_ns, last_ns = (messages[0][0], messages[-1][0]) if messages else (0, 0)
        content = struct.pack("<QHIIIIQQ", len(messages), len(self._schemas), len(counts), 0, 0, 0, first_ns, last_ns)
        content += struct.pack("<I", 10 * len(counts))
        content += b"".join(struct.pack("<HQ", number, count) for number, count in enumerate(counts))
        return _record(STATISTICS, content)


def _record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def _string(text: str) -> bytes:
    data = text.encode()
    return struct.pack("<I", len(data)) + data
