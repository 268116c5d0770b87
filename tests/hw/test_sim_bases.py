"""Simulated wheel bases answer what other people's programs ask, and drive as these tell them."""

from __future__ import annotations

import math
import struct

import numpy as np
import pytest

from hw import create2, kobuki, roboclaw
from hw.sim.arduino_sim import ArduinoBridgeSim
from hw.sim.bases_sim import Counting
from hw.sim.catalogue import BASES
from hw.sim.create2_sim import Create2Sim
from hw.sim.devices import ByteDevice
from hw.sim.kobuki_sim import KobukiSim
from hw.sim.obedient import ObedientRobot
from hw.sim.roboclaw_sim import RoboClawSim
from hw.sim.roboclaw_tables import FACTS, WRITES, ZEROS
from tests.harness.serial_device import POSE, ROOM


class Turned:
    """Wheels that have turned so far."""

    def ticks_at(self, time_s: float) -> tuple[int, int]:
        return -100, 70000


def answer(device: object, request: bytes, seconds: float = 0.1) -> bytes:
    device.receive(request, 5.0)  # type: ignore[attr-defined]
    return device.emit(5.0) + device.emit(5.0 + seconds)  # type: ignore[attr-defined]


@pytest.fixture
def robot() -> Create2Sim:
    robot = Create2Sim(Counting(Turned()))
    robot.receive(bytes((create2.START, create2.SAFE)), 4.0)
    return robot


GROUP_BYTES = {0: 26, 1: 10, 2: 6, 3: 10, 4: 14, 5: 12, 6: 52, 100: 80, 101: 28, 106: 12, 107: 9}


@pytest.mark.parametrize(("group", "size"), GROUP_BYTES.items())
def test_every_group_of_a_create2_has_its_size(robot: Create2Sim, group: int, size: int) -> None:
    assert len(answer(robot, bytes((142, group)))) == size


def test_a_create2_counts_in_16_bits_and_tells_its_mode(robot: Create2Sim) -> None:
    assert answer(robot, bytes((149, 3, 43, 44, 35))) == struct.pack(">HHB", 65436, 4464, 2)


def test_a_create2_knows_the_length_of_commands_it_does_not_carry_out(robot: Create2Sim) -> None:
    ignored = bytes((140, 0, 2, 60, 32, 64, 32)) + bytes((141, 0)) + bytes((164, 65, 66, 67, 68)) + bytes((145, 0, 100, 0, 100))
    assert answer(robot, ignored + bytes((142, 35))) == b"\x02"


def test_a_create2_streams_packets_and_groups(robot: Create2Sim) -> None:
    robot.emit(4.99)
    robot.receive(bytes((148, 2, 43, 101)), 5.0)
    frame = robot.emit(5.01)
    assert len(frame) == 3 + 3 + 1 + GROUP_BYTES[101] and sum(frame) % 256 == 0
    assert (frame[2], frame[5]) == (43, 101) and frame[3:5] == frame[6:8], "the group begins with the same counter"


def test_a_create2_that_is_off_hears_only_start() -> None:
    assert answer(Create2Sim(Counting(Turned())), bytes((142, 35))) == b""


def test_a_create2_reboots(robot: Create2Sim) -> None:
    robot.receive(b"\x07", 5.0)
    assert robot.emit(5.1) + robot.emit(6.1) == b"Soft reset!\n\xfe"
    assert robot.emit(8.1).startswith(b"Roomba")
    assert answer(robot, bytes((142, 35))) == b"", "it is off again"


def test_a_create2_tells_its_way_and_its_turn_since_they_were_last_told() -> None:
    robot = ObedientRobot(ROOM, POSE, BASES["create2"].drive)
    base = Create2Sim(Counting(robot))
    base.receive(bytes((128, 131, 145)) + struct.pack(">hh", 250, 150), 5.0)
    told = []
    for k in range(1, 5):
        base.receive(bytes((149, 6, 19, 20, 41, 42, 39, 40)), 5.0 + k / 2)
        told.append(struct.unpack(">6h", base.emit(5.0 + k / 2 + 0.01)))
    way_mm, turn_deg = (sum(values) for values in list(zip(*told, strict=True))[:2])
    assert (way_mm, turn_deg) == pytest.approx((400, math.degrees(2 * 100 / 235)), abs=1)
    assert told[0][2:] == (250, 150, 0, 0)


def test_a_create2_changes_its_rate_until_it_is_reset(robot: Create2Sim) -> None:
    robot.receive(bytes((129, 7)), 5.0)
    assert robot.baud == 19200
    robot.receive(bytes((7,)), 5.1)
    assert robot.baud == 115200


def test_a_roboclaw_takes_a_command_in_pieces_and_answers_by_any_address() -> None:
    board = RoboClawSim(Counting(Turned()))
    command = roboclaw.write_command(0x83, 37, struct.pack(">ii", 1000, -1000))
    for k, byte in enumerate(command):
        assert board.emit(1.0) == b""
        board.receive(bytes((byte,)), 1.0 + 0.001 * k)
    assert board.emit(1.1) == b"\xff"
    assert roboclaw.decode_counts(0x83, answer(board, bytes((0x83, roboclaw.READ_ENCODERS)))) == (-100, 70000)


def test_a_roboclaw_drops_half_a_command_and_one_with_a_wrong_sum() -> None:
    board = RoboClawSim(Counting(Turned()))
    board.receive(roboclaw.write_command(0x80, 37, bytes(8))[:5], 1.0)
    assert roboclaw.decode_counts(0x80, answer(board, bytes((0x80, roboclaw.READ_ENCODERS)))) == (-100, 70000)
    assert answer(board, roboclaw.write_command(0x80, 6, b"\x10")[:-1] + b"\0") == b""


@pytest.mark.parametrize("code", [*FACTS, *ZEROS, 16, 17, 18, 19, 30, 31, 47, 73, 78, 79, 108])
def test_a_roboclaw_answers_every_read_with_its_checksum(code: int) -> None:
    said = answer(RoboClawSim(Counting(Turned())), bytes((0x81, code)))
    assert roboclaw.opened(0x81, code, said), "data, and a checksum that covers the question"
    assert code not in WRITES


def test_a_roboclaw_sets_its_counters() -> None:
    board = RoboClawSim(Counting(Turned()))
    assert answer(board, roboclaw.write_command(0x80, 23, struct.pack(">i", -7))) == b"\xff"
    assert roboclaw.decode_counts(0x80, answer(board, bytes((0x80, roboclaw.READ_ENCODERS)))) == (-100, -7)


def test_a_roboclaw_goes_ways_one_behind_the_other_and_says_when_it_is_there() -> None:
    robot = ObedientRobot(ROOM, POSE, BASES["roboclaw"].drive)
    board, ask = RoboClawSim(Counting(robot)), bytes((0x80, 47))
    board.receive(roboclaw.write_command(0x80, 43, struct.pack(">iIiIB", 1000, 500, -1000, 1000, 1)), 1.0)
    board.receive(roboclaw.write_command(0x80, 41, struct.pack(">iIB", 2000, 500, 0)), 1.0)
    assert board.emit(1.0) == b"\xff\xff"
    for when_s, ticks, buffers in ((1.4, (400, -400), b"\1\0"), (1.7, (900, -700), b"\0\0"), (2.5, (1000, -1000), b"\x80\x80")):
        board.receive(ask, when_s)
        assert roboclaw.opened(0x80, 47, board.emit(when_s)) == buffers
        assert robot.ticks_at(when_s) == pytest.approx(ticks, abs=1)
    board.receive(roboclaw.write_command(0x80, 66, struct.pack(">IIIiB", 0, 2000, 0, 0, 1)), 3.0)
    board.emit(4.0)
    assert robot.ticks_at(4.0) == pytest.approx((1000, 0), abs=1), "back to where its counter was 0"


def test_a_roboclaw_mixes_ahead_and_aside() -> None:
    robot = ObedientRobot(ROOM, POSE, BASES["roboclaw"].drive)
    board = RoboClawSim(Counting(robot))
    board.receive(roboclaw.write_command(0x80, 8, b"\x40") + roboclaw.write_command(0x80, 11, b"\x20"), 1.0)
    left, right = robot.ticks_at(2.0)
    assert (left, right) == pytest.approx((5000 * 32 / 127, 5000 * 96 / 127), abs=1)


@pytest.mark.parametrize(("line", "said"), [
    (b"b", b"57600\r\n"), (b"e", b"-100 70000\r\n"), (b"r", b"OK\r\n"), (b"m 10 10", b"OK\r\n"), (b"u 20:12:0:50", b"OK\r\n"),
    (b"a 3", b"512\r\n"), (b"d 2", b"0\r\n"), (b"p 5", b"100\r\n"), (b"t 0", b"90\r\n"), (b"c 13 1", b"OK\r\n"),
    (b"w 13 1", b"OK\r\n"), (b"x 9 128", b"OK\r\n"), (b"s 0 90", b"OK\r\n"), (b"o 100 -100", b"OK\r\n"),
    (b"", b"Invalid Command\r\n"), (b"q", b"Invalid Command\r\n"),
])  # fmt: skip
def test_an_arduino_bridge_answers_each_command_of_its_sketch(line: bytes, said: bytes) -> None:
    assert answer(ArduinoBridgeSim(Counting(Turned())), line + b"\r") == said


def test_an_arduino_bridge_stops_by_itself() -> None:
    robot = ObedientRobot(ROOM, POSE, BASES["arduino-bridge"].drive)
    board = ArduinoBridgeSim(Counting(robot))
    board.receive(b"m 10 20\r", 1.0)
    board.emit(3.5)
    assert [robot.ticks_at(t) for t in (1.5, 3.0, 9.0)] == [(150, 300), (600, 1200), (600, 1200)]


def test_a_kobuki_frame_holds_what_a_real_one_does() -> None:
    frame = KobukiSim(Counting(Turned())).emit(1.0)
    assert frame[2] == 77, "some hosts know a frame by its usual length"
    parts = kobuki.decode(frame)
    assert parts is not None
    assert {code: len(part) for code, part in parts.items()} == {1: 15, 3: 3, 4: 7, 5: 6, 6: 2, 13: 14, 16: 16}


def test_a_kobuki_tells_once_what_it_is_asked() -> None:
    base = KobukiSim(Counting(Turned()))
    base.emit(1.0)
    base.receive(b"\xaa" + kobuki.request_extra(1 | 2 | 8) + kobuki.encode(b"\x0e\x01\x00"), 1.01)
    told, after = kobuki.decode(base.emit(1.02)), kobuki.decode(base.emit(1.04))
    assert told is not None and after is not None
    assert {code: len(told[code]) for code in told.keys() - after.keys()} == {10: 4, 11: 4, 19: 12, 21: 13}
    gains = struct.pack("<B3I", 1, 7, 8, 9)
    base.receive(kobuki.encode(b"\x0d\x0d" + gains) + kobuki.encode(b"\x0e\x01\x00"), 1.05)
    told = kobuki.decode(base.emit(1.06))
    assert told is not None and told[21] == gains


COMMANDS: dict[str, tuple[bytes, float, float]] = {  # commands, and the speeds of left and right wheel they mean, m/s
    "create2 direct": (bytes((128, 132, 145)) + struct.pack(">hh", 300, 100), 0.1, 0.3),
    "create2 arc": (bytes((128, 131, 137)) + struct.pack(">hh", 200, 1000), 0.2 * (1 - 0.1175), 0.2 * (1 + 0.1175)),
    "create2 spin": (bytes((128, 131, 137)) + struct.pack(">hh", 100, -1), 0.1, -0.1),
    "create2 not in passive mode": (bytes((128, 145)) + struct.pack(">hh", 300, 100), 0.0, 0.0),
    "kobuki straight": (kobuki.base_control(200, 0), 0.2, 0.2),
    "kobuki spin": (kobuki.base_control(100, 1), -0.1, 0.1),
    "kobuki arc": (kobuki.base_control(230, -345), 0.23, 0.115),
    "roboclaw speeds": (roboclaw.write_command(0x80, 37, struct.pack(">ii", 1000, -500)), 0.153398, -0.076699),
    "arduino-bridge speeds": (b"m 40 -20\r", 0.184078, -0.092039),
}


@pytest.mark.parametrize("case", COMMANDS)
def test_wheels_turn_as_a_client_tells_them(case: str) -> None:
    command, *speeds_mps = COMMANDS[case]
    kind = BASES[case.split(maxsplit=1)[0]]
    robot = ObedientRobot(ROOM, POSE, kind.drive)
    base: ByteDevice = kind.make(robot)
    base.emit(4.9)
    base.receive(command, 5.0)
    metres_per_tick = 6.283185307 * kind.drive.wheel_radius_m / kind.drive.ticks_per_revolution
    rolled_m = [ticks * metres_per_tick for ticks in robot.ticks_at(6.0)]
    assert rolled_m == pytest.approx(speeds_mps, abs=2 * metres_per_tick)


def test_a_robot_that_is_told_to_drive_takes_its_lidar_along() -> None:
    robot = ObedientRobot(ROOM, POSE, BASES["kobuki"].drive)
    robot.turn_wheels(1000, 1000, 5.0)
    before, after = robot.poses_at(np.array([4.0, 6.0]))
    assert before[:3] == pytest.approx([POSE.x_m, POSE.y_m, POSE.theta_rad])
    assert math.hypot(*(after[:2] - before[:2])) == pytest.approx(1000 * kobuki.GEOMETRY.metres_per_tick)
    assert after[3] == after[4] == pytest.approx(0.085292, abs=1e-5)
