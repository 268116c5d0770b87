"""Every LIDAR vector of `data/serial.json` (vendor manuals, real captures) decodes to what it says, and encodes back."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hw import ld06, rplidar_wire, scip, sick_wire, xv11, ydlidar_wire
from hw.rplidar import Rplidar
from hw.rplidar_nodes import Node

VECTORS: list[dict[str, Any]] = json.loads((Path(__file__).parent / "data" / "serial.json").read_text())


def _of(device: str, kind: str, *names: str) -> list[Any]:
    found = [v for v in VECTORS if v["device"] == device and v["kind"] == kind and (not names or v["name"] in names)]
    assert found
    return [pytest.param(v, id=f"{v['name']}-{i}") for i, v in enumerate(found)]


@pytest.mark.parametrize("vector", _of("rplidar", "decode", "legacy node"))
def test_rplidar_node(vector: dict[str, Any]) -> None:
    data, expect = bytes.fromhex(vector["hex"]), vector["expect"]
    node = Node.decode(data)
    assert node is not None
    assert (node.is_start, node.quality) == (bool(expect["s"]), expect["q"])
    assert (node.angle_q6 / 64, node.distance_q2 / 4) == (expect["deg"], expect["mm"])
    assert node.encode() == data


@pytest.mark.parametrize("vector", _of("rplidar", "reject"))
def test_rplidar_node_that_is_none(vector: dict[str, Any]) -> None:
    assert Node.decode(bytes.fromhex(vector["hex"])) is None


@pytest.mark.parametrize("vector", _of("rplidar", "descriptor"))
def test_rplidar_descriptor(vector: dict[str, Any]) -> None:
    data, expect = bytes.fromhex(vector["hex"]), vector["expect"]
    descriptor = rplidar_wire.Descriptor.decode(data)
    assert descriptor == rplidar_wire.Descriptor(expect["len"], bool(expect["multi"]), expect["type"])
    assert descriptor.encode() == data


REQUESTS = {
    "request express mode 0": rplidar_wire.express_request(0),
    "request pwm 660": rplidar_wire.request(rplidar_wire.PWM_CMD, (660).to_bytes(2, "little")),
    "request rpm 600": rplidar_wire.request(rplidar_wire.RPM_CMD, (600).to_bytes(2, "little")),
    "request conf mode count": rplidar_wire.conf_request(rplidar_wire.CONF_MODE_COUNT),
    "request conf us/sample mode 1": rplidar_wire.conf_request(rplidar_wire.CONF_SAMPLE_US, 1),
}


@pytest.mark.parametrize("vector", _of("rplidar", "encode"))
def test_rplidar_request(vector: dict[str, Any]) -> None:
    data = bytes.fromhex(vector["hex"])
    assert REQUESTS[vector["name"]] == data
    request, used = rplidar_wire.parse_request(b"\x00" + data)
    assert request is not None and used == len(data) + 1
    assert rplidar_wire.request(request.command, request.payload) == data


@pytest.mark.parametrize("vector", _of("rplidar", "decode", "INFO answer after one junk byte"))
def test_rplidar_info_of_a_real_device(vector: dict[str, Any]) -> None:
    data, expect = bytes.fromhex(vector["hex"]), vector["expect"]
    driver = Rplidar()
    driver.feed(data, 1.0)
    assert driver.info is not None
    assert (driver.info.model, f"{driver.info.firmware[0]}.{driver.info.firmware[1]}") == (expect["model"], expect["fw"])
    assert (driver.info.hardware, driver.info.serial.hex()) == (expect["hw"], expect["serial"])
    assert rplidar_wire.answer(rplidar_wire.INFO_TYPE, driver.info.encode()) == data[1:]


@pytest.mark.parametrize("vector", _of("ldrobot", "decode"))
def test_ldrobot_packet(vector: dict[str, Any]) -> None:
    data, expect = bytes.fromhex(vector["hex"]), vector["expect"]
    packet = ld06.decode(data)
    assert packet is not None
    assert (packet.speed_dps, packet.clock_ms) == (expect["speed_dps"], expect["ts_ms"])
    assert (packet.start_cdeg / 100, packet.end_cdeg / 100) == (expect["start"], expect["end"])
    assert (list(packet.distances_mm), list(packet.intensities)) == (expect["mm"], expect["intensity"])
    assert ld06.encode(packet) == data


@pytest.mark.parametrize("vector", _of("ydlidar", "decode"))
def test_ydlidar_packet(vector: dict[str, Any]) -> None:
    data, expect = bytes.fromhex(vector["hex"]), vector["expect"]
    packet = ydlidar_wire.decode(data)
    assert packet is not None
    assert (int(packet.is_start), len(packet.samples), packet.first_q6 / 64) == (expect["ct"], expect["n"], expect["fsa"])
    assert packet.last_q6 / 64 == expect.get("lsa", packet.last_q6 / 64)
    mm = [word / 4 for word in packet.samples]
    assert mm == expect["mm"] if "mm" in expect else mm[: len(expect["mm_first"])] == expect["mm_first"]
    assert ydlidar_wire.encode(packet) == data


def test_ydlidar_angles_are_corrected_as_the_vendor_says() -> None:
    assert ydlidar_wire.correction_deg(np.array([1000.0, 8000.0, 0.0])) == pytest.approx([-6.7622, -7.8374, 0.0], abs=1e-4)
    raw = 326.5 + np.arange(4) * (347.578125 - 326.5) / 35
    corrected = raw + ydlidar_wire.correction_deg(np.array([298.25, 297.25, 297.25, 297.25]))
    assert corrected == pytest.approx([322.651, 323.267, 323.869, 324.472], abs=1e-3)


@pytest.mark.parametrize("vector", _of("scip", "sum"))
def test_scip_sum(vector: dict[str, Any]) -> None:
    text = vector["text"].encode()
    assert chr(scip.line_sum(text)) == vector["expect"]
    assert scip.is_line_good(text + vector["expect"].encode())


@pytest.mark.parametrize("vector", _of("scip", "value"))
def test_scip_value(vector: dict[str, Any]) -> None:
    text = vector["text"].encode()
    assert scip.decode_value(text) == vector["expect"]
    assert scip.encode_value(vector["expect"], len(text)) == text
    assert scip.decode_values(text * 3, len(text)).tolist() == [vector["expect"]] * 3


@pytest.mark.parametrize("vector", _of("sick_lms2xx", "frame"))
def test_sick_telegram(vector: dict[str, Any]) -> None:
    data = bytes.fromhex(vector["hex"])
    decoded = sick_wire.decode(data)
    assert decoded is not None
    assert sick_wire.encode(decoded[1], decoded[0]) == data


def test_sick_requests_are_the_ones_the_driver_sends() -> None:
    by_name = {v["name"]: bytes.fromhex(v["hex"]) for v in VECTORS if v["device"] == "sick_lms2xx"}
    assert sick_wire.encode(sick_wire.STATUS) == by_name["status"]
    assert sick_wire.encode(sick_wire.TYPE) == by_name["type"]
    assert sick_wire.encode(sick_wire.CONTINUOUS) == by_name["continuous on"]
    assert sick_wire.encode(sick_wire.POLLED) == by_name["off"]
    assert sick_wire.encode(bytes((sick_wire.MODE, sick_wire.RATE_CODES[38400]))) == by_name["38400"]
    assert sick_wire.encode(bytes((sick_wire.MODE, sick_wire.RATE_CODES[500000]))) == by_name["500000"]
    assert sick_wire.encode(sick_wire.INSTALL) == by_name["install mode"]
    assert sick_wire.encode(sick_wire.variant_request(180, 0.5)) == by_name["180/0.5"]
    assert sick_wire.encode(sick_wire.variant_request(180, 1.0)) == by_name["180/1.0"]


@pytest.mark.parametrize("vector", _of("neato", "decode"))
def test_xv11_packet(vector: dict[str, Any]) -> None:
    data, expect = bytes.fromhex(vector["hex"]), vector["expect"]
    packet = xv11.decode_xv11(data)
    assert packet is not None
    assert (4 * packet.index, packet.rpm) == (expect["first_deg"], expect["rpm"])
    assert (list(packet.distances_mm), list(packet.signals)) == (expect["mm"], expect["signal"])
    assert [int(w) for w in packet.is_weak] == expect["warn"]
    assert xv11.encode_xv11(packet) == data


def test_check_values_of_the_checksums() -> None:
    assert ld06.crc8(b"123456789") == 0xC3
    assert (ld06.crc8(b"\x01"), ld06.crc8(b"\xff")) == (0x4D, 0xA8)
    assert rplidar_wire.xor8(bytes(range(100))) == _xor(bytes(range(100)))


def _xor(data: bytes) -> int:
    value = 0
    for byte in data:
        value ^= byte
    return value
