"""Simulated LIDARs answer what other people's programs ask, not only what our own drivers do."""

from __future__ import annotations

import math
import struct
from itertools import pairwise

import numpy as np
import pytest

from hw import rplidar_wire, scip, ydlidar_wire
from hw.rplidar_capsules import KINDS, start_angles_q6
from hw.sim.catalogue import HOKUYOS
from hw.sim.hokuyo_sim import HokuyoSim
from hw.sim.obedient import ObedientRobot
from hw.sim.rplidar_sim import RplidarSim
from hw.sim.sight import Sight
from hw.sim.ydlidar_sim import YdlidarSim
from tests.harness.serial_device import POSE, ROOM


def sight() -> Sight:
    return Sight(ObedientRobot(ROOM, POSE), noise_m=0.0)


def answer(device: object, request: bytes, seconds: float = 0.1) -> bytes:
    device.receive(request, 5.0)  # type: ignore[attr-defined]
    return device.emit(5.0) + device.emit(5.0 + seconds)  # type: ignore[attr-defined]


@pytest.mark.parametrize("question", [0x91, ydlidar_wire.HEALTH])
def test_a_ydlidar_tells_its_health_by_the_old_command_and_the_new(question: int) -> None:
    lidar = YdlidarSim("x4", sight())
    assert answer(lidar, ydlidar_wire.command(question)) == ydlidar_wire.answer(ydlidar_wire.HEALTH_TYPE, b"\0\0\0")


@pytest.mark.parametrize(("code", "body"), [
    (0x0D, struct.pack("<I", 800)), (0x09, struct.pack("<I", 810)), (0x0C, struct.pack("<I", 700)),
    (0xD1, b"\0"), (0xD0, b"\0"), (0x93, bytes(4)), (0xD9, b"\0"), (0x01, b"\1"), (0x0F, b"\0"),
])  # fmt: skip
def test_a_ydlidar_tells_its_settings(code: int, body: bytes) -> None:
    said = answer(YdlidarSim("x4", sight()), ydlidar_wire.command(code))
    assert said == ydlidar_wire.answer(ydlidar_wire.INFO_TYPE, body)


def starts(stream: bytes) -> int:
    """How many turns begin in it."""
    return stream.count(b"\xaa\x55\xa1\x01") + stream.count(b"\xaa\x55\xc9\x01")


def test_a_ydlidar_turns_as_fast_as_it_is_told_and_takes_a_second_order_to_scan_for_a_heartbeat() -> None:
    lidar, scan = YdlidarSim("x4", sight()), ydlidar_wire.command(ydlidar_wire.SCAN)
    usual = answer(lidar, scan, 0.01) + b"".join(lidar.emit(5.0 + k / 100) for k in range(2, 48))
    assert starts(usual) == 4, "8 a second"
    lidar.receive(b"\xa5" + scan, 5.48)
    assert starts(b"".join(lidar.emit(5.48 + k / 100) for k in range(25))) == 2, "behind a stray A5, and without a jump"
    for _ in range(2):
        lidar.receive(ydlidar_wire.command(0x0B), 6.0)
    faster = answer(lidar, ydlidar_wire.command(ydlidar_wire.STOP)) + answer(lidar, scan, 0.01)
    faster += b"".join(lidar.emit(5.0 + k / 100) for k in range(2, 48))
    assert starts(faster) == 5, "10 a second"


@pytest.mark.parametrize(("key", "value"), [
    (rplidar_wire.CONF_SPEED, struct.pack("<HH", 600, 660)), (rplidar_wire.CONF_SLOWEST, struct.pack("<H", 300)),
    (rplidar_wire.CONF_FASTEST, struct.pack("<H", 1200)), (rplidar_wire.CONF_MODEL_NAME, b"RPLIDAR C1M1\0"),
])  # fmt: skip
def test_an_rplidar_tells_its_speeds_and_its_name(key: int, value: bytes) -> None:
    said = answer(RplidarSim("rplidar-c1", sight()), rplidar_wire.conf_request(key))
    assert said == rplidar_wire.answer(rplidar_wire.CONF_TYPE, rplidar_wire.Conf(key, value).encode())


def test_an_rplidar_says_hello_when_it_has_booted_and_hears_nothing_before() -> None:
    lidar = RplidarSim("rplidar-a1", sight())
    assert answer(lidar, rplidar_wire.request(rplidar_wire.RESET_CMD) + rplidar_wire.request(rplidar_wire.INFO_CMD), 0.0) == b""
    hello = answer(lidar, rplidar_wire.request(rplidar_wire.HEALTH_CMD))
    assert hello == b"RP LIDAR System.\r\nFirmware Ver 1.29 - rtm, HW Ver 7\r\nModel: 18\r\n"
    assert len(hello) == 64, "some hosts count them"


@pytest.mark.parametrize(
    "garbage", [b"\xa5", b"\xa5\xa5", b"\xa5\xff\xa5", b"\xa5\x82\xa5", b"\0\xa5\xb7", b"\xa5\x84\x02\0\xa5\x5a"]
)
def test_an_rplidar_hears_what_comes_behind_garbage(garbage: bytes) -> None:
    lidar, question = RplidarSim("rplidar-a1", sight()), rplidar_wire.request(rplidar_wire.HEALTH_CMD)
    health = rplidar_wire.answer(rplidar_wire.HEALTH_TYPE, bytes(3))
    assert answer(lidar, garbage + question) == health


@pytest.mark.parametrize(("model", "mode", "hz"), [
    ("rplidar-a1", 1, 5), ("rplidar-a1", 2, 5), ("rplidar-a3", 3, 10), ("rplidar-a3", 4, 10), ("rplidar-s1", 1, 10),
    ("rplidar-c1", 1, 10), ("rplidar-s2", 1, 10), ("rplidar-s2", 2, 10), ("rplidar-s3", 1, 10),
])  # fmt: skip
def test_the_makers_sdk_sees_every_turn_of_an_rplidar_pass(model: str, mode: int, hz: int) -> None:
    """It counts in whole numbers: a turn begins where the angle of the next beam, rounded down, is past zero."""
    lidar = RplidarSim(model, sight())
    lidar.receive(rplidar_wire.express_request(mode), 5.0)
    stream = b"".join(lidar.emit(5.0 + k / 50) for k in range(51))[7:]
    kind = KINDS[lidar.unit.modes[mode].type]
    capsules = np.frombuffer(stream[: len(stream) // kind.length * kind.length], np.uint8).reshape(-1, kind.length)
    starts_q16 = (start_angles_q6(kind, capsules)[0].astype(int) & 0x7FFF) << 10
    turns, circle_q16 = 0, 360 << 16
    for start_q16, next_q16 in pairwise(starts_q16.tolist()):
        step_q16 = (next_q16 - start_q16) % circle_q16 // kind.samples
        turns += sum((start_q16 + (k + 1) * step_q16) % circle_q16 < step_q16 for k in range(kind.samples))
    assert turns == pytest.approx(hz, abs=1)


def test_an_rplidar_forgets_half_a_request_and_takes_one_in_two_halves() -> None:
    lidar, question = RplidarSim("rplidar-c1", sight()), rplidar_wire.conf_request(rplidar_wire.CONF_MODE_COUNT)
    told = rplidar_wire.answer(rplidar_wire.CONF_TYPE, rplidar_wire.Conf(rplidar_wire.CONF_MODE_COUNT, b"\2\0").encode())
    lidar.receive(question[:5], 5.0)
    lidar.receive(question[5:], 5.5)
    assert lidar.emit(5.5) == told
    lidar.receive(b"\xa5\x84\x24", 6.0)
    for k in range(4):
        lidar.receive(question, 6.0 + 0.4 * k)
    assert lidar.emit(8.0) == told, "the last, a second after a request that never came to its end had begun"


def test_an_rplidar_says_that_a_setting_is_taken_and_turns_as_fast_as_it_is_told() -> None:
    lidar = RplidarSim("rplidar-s2", sight())
    assert answer(lidar, rplidar_wire.request(0x85, bytes(6))) == rplidar_wire.answer(0x21, bytes(8))
    lidar.receive(rplidar_wire.request(rplidar_wire.RPM_CMD, struct.pack("<H", 900)), 6.0)
    lidar.receive(rplidar_wire.request(rplidar_wire.SCAN_CMD), 6.0)
    nodes = np.frombuffer(lidar.emit(6.0)[7:] + b"".join(lidar.emit(6.0 + k / 100) for k in range(1, 41)), np.uint8).reshape(
        -1, 5
    )
    assert np.count_nonzero(nodes[:, 0] & 1) == 6, "turns of 1/15 s, begun in 0.4 s"


def test_an_rplidar_that_is_told_to_stop_has_measured_until_then() -> None:
    lidar = RplidarSim("rplidar-a1", sight())
    answer(lidar, rplidar_wire.request(rplidar_wire.SCAN_CMD))
    lidar.receive(rplidar_wire.request(rplidar_wire.STOP_CMD), 5.11)
    assert len(lidar.emit(5.12)) == 5 * 20, "2 kHz for 10 ms"
    assert lidar.emit(5.2) == b""


def test_a_hokuyo_reboots_when_it_is_told_twice() -> None:
    lidar = HokuyoSim(HOKUYOS["hokuyo-urg"], sight())
    assert answer(lidar, b"RB\n") == scip.encode_message(b"RB", b"01")
    assert answer(lidar, b"RB\n") == scip.encode_message(b"RB", b"00")
    assert answer(lidar, b"BM\n") == scip.encode_message(b"BM", b"10"), "it boots"


@pytest.mark.parametrize(("line", "status"), [
    (b"MD00xx0725010000", b"0D"), (b"MD00x40725010000"[:15], b"01"), (b"MD0044072x01000", b"02"), (b"MD00440725x1000", b"03"),
    (b"MD0044072501x00", b"06"), (b"MD00440725010x0", b"07"), (b"MD0044076801000", b"04"), (b"MD0700004401000", b"05"),
    (b"MD004407250100", b"0C"), (b"GD004407250", b"0C"), (b"GD0044072501", b"10"), (b"XY", b"0E"),
    (b"VV;" + 17 * b"a", b"0G"), (b"VV;a\x01", b"0H"),
])  # fmt: skip
def test_a_hokuyo_says_what_is_wrong_with_a_request(line: bytes, status: bytes) -> None:
    assert answer(HokuyoSim(HOKUYOS["hokuyo-urg"], sight()), line + b"\n", 0.0) == scip.encode_message(line, status)


def test_a_hokuyo_tells_the_nearest_of_a_cluster_and_counts_down() -> None:
    lidar = HokuyoSim(HOKUYOS["hokuyo-urg"], sight())
    answer(lidar, b"BM\n", 0.0)
    lidar.receive(b"GD0044072501\n", 5.0)
    (fine,) = scans(b"".join(lidar.emit(5.0 + k / 50) for k in range(6)))
    lidar.receive(b"MD0044072504002;tag\n", 5.2)
    said = b"".join(lidar.emit(5.2 + k / 50) for k in range(25))
    coarse, again = scans(said)
    assert [scip.decode_message(b).echo[-6:] for b in said.split(b"\n\n")[:-1]] == [b"02;tag", b"01;tag", b"00;tag"]  # type: ignore[union-attr]
    assert len(coarse) == math.ceil(682 / 4)
    assert coarse == again == [min(fine[k : k + 4]) for k in range(0, 682, 4)]


def scans(said: bytes) -> list[list[int]]:
    """The distances of each scan in what a Hokuyo said."""
    messages = [scip.decode_message(block) for block in said.split(b"\n\n")[:-1]]
    found = [scip.scan_of(message) for message in messages if message is not None]
    return [scan.values.tolist() for scan in found if scan is not None]
