"""MCAP files: every record where the specification says, every number where CDR says; read by the reference too."""

from __future__ import annotations

import io
import math
import struct
from collections.abc import Iterator

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from agent.mcap_file import CHANNEL, DATA_END, FOOTER, HEADER, MAGIC, MESSAGE, SCHEMA, STATISTICS, McapFile
from agent.ros_messages import DEFINITIONS, OCCUPANCY_GRID, PATH, TF, occupancy_grid, path, transforms
from protocol.geometry import SE2
from protocol.grid import OccupancyGrid

GRID = OccupancyGrid(np.array([[0, 100, -1], [-1, -1, 0]], np.int8), 0.25, SE2(-1.0, 2.0, math.pi / 2))


def records(data: bytes) -> Iterator[tuple[int, bytes]]:
    assert data.startswith(MAGIC)
    assert data.endswith(MAGIC)
    at = len(MAGIC)
    while at < len(data) - len(MAGIC):
        opcode, length = struct.unpack_from("<BQ", data, at)
        yield opcode, data[at + 9 : at + 9 + length]
        at += 9 + length
    assert at == len(data) - len(MAGIC)


def whole_file() -> bytes:
    mcap = McapFile()
    mcap.add("/tf", TF, 2.0, transforms(2.0, [("r1/map", "r1/base_link", SE2(1.0, 0.0, 0.0))]))
    mcap.add("/r1/map", OCCUPANCY_GRID, 1.0, occupancy_grid(GRID, 1.0, "r1/map"))
    mcap.add("/tf", TF, 3.0, transforms(3.0, [("r1/map", "r1/base_link", SE2(2.0, 0.0, 0.0))]))
    mcap.add("/r1/path", PATH, 3.0, path([2.0, 3.0], [SE2(1.0, 0.0, 0.0), SE2(2.0, 0.0, 0.0)], "r1/map"))
    return mcap.encoded()


def test_records_come_in_the_order_of_the_specification() -> None:
    found = list(records(whole_file()))
    definitions = [SCHEMA] * 3 + [CHANNEL] * 3
    assert [opcode for opcode, _ in found] == [HEADER, *definitions, *[MESSAGE] * 4, DATA_END, *definitions, STATISTICS, FOOTER]
    stamps = [struct.unpack_from("<HIQQ", content)[2] for opcode, content in found if opcode == MESSAGE]
    assert stamps == [1_000_000_000, 2_000_000_000, 3_000_000_000, 3_000_000_000]


def test_the_footer_points_to_the_summary() -> None:
    data = whole_file()
    [footer] = [content for opcode, content in records(data) if opcode == FOOTER]
    start = struct.unpack("<QQI", footer)[0]
    assert data[start] == SCHEMA
    assert data[start - 13] == DATA_END
    [statistics] = [content for opcode, content in records(data) if opcode == STATISTICS]
    assert struct.unpack_from("<QHI", statistics) == (4, 3, 3)
    assert struct.unpack_from("<HQHQHQ", statistics, len(statistics) - 30) == (0, 2, 1, 1, 2, 1)


def test_a_grid_lies_in_cdr_as_ros_would_write_it() -> None:
    cdr = occupancy_grid(GRID, 1.5, "m")
    body = cdr[4:]
    assert cdr[:4] == b"\x00\x01\x00\x00"
    assert struct.unpack_from("<iII2s", body) == (1, 500_000_000, 2, b"m\0")
    assert struct.unpack_from("<iIfII", body, 16) == (1, 500_000_000, 0.25, 3, 2)  # aligned to 4 behind the string
    assert struct.unpack_from("<7d", body, 40) == pytest.approx((-1, 2, 0, 0, 0, math.sqrt(0.5), math.sqrt(0.5)))  # aligned to 8
    assert struct.unpack_from("<I6b", body, 96) == (6, 0, 100, -1, -1, -1, 0)
    assert len(body) == 106


def test_every_definition_brings_what_it_names() -> None:
    for text in DEFINITIONS.values():
        parts = text.split("\n" + "=" * 80 + "\n")
        brought = {part.splitlines()[0].removeprefix("MSG: ") for part in parts[1:]}
        named = {line.split()[0].removesuffix("[]") for part in parts for line in part.splitlines() if "/" in line.split()[0]}
        assert named == brought


def test_an_empty_file_is_a_file() -> None:
    assert [opcode for opcode, _ in records(McapFile().encoded())] == [HEADER, DATA_END, STATISTICS, FOOTER]


def test_the_reference_reader_reads_it() -> None:
    reader = make_reader(io.BytesIO(whole_file()), decoder_factories=[DecoderFactory()])
    found = [(channel.topic, message) for _, channel, _, message in reader.iter_decoded_messages()]
    assert [topic for topic, _ in found] == ["/r1/map", "/tf", "/tf", "/r1/path"]
    grid, last = found[0][1], found[3][1].poses[-1]
    assert list(grid.data) == GRID.cells.ravel().tolist()
    assert (grid.info.width, grid.info.height, grid.header.frame_id) == (3, 2, "r1/map")
    assert last.pose.position.x == 2.0
