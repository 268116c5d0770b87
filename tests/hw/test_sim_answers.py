"""Simulated devices answer what other people's programs ask, not only what our own drivers do."""

from __future__ import annotations

import struct

import pytest

from hw import create2, roboclaw, ydlidar_wire
from hw.sim.bases_sim import Counting, RoboClawSim
from hw.sim.create2_sim import Create2Sim
from hw.sim.sight import Sight, Standing
from hw.sim.spinning_sim import YdlidarSim
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


def test_a_create2_that_is_off_hears_only_start() -> None:
    assert answer(Create2Sim(Counting(Turned())), bytes((142, 35))) == b""


def test_a_create2_reboots(robot: Create2Sim) -> None:
    robot.receive(b"\x07", 5.0)
    assert robot.emit(5.1) + robot.emit(6.1) == b"Soft reset!\n\xfe"
    assert robot.emit(8.1).startswith(b"Roomba")
    assert answer(robot, bytes((142, 35))) == b"", "it is off again"


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


@pytest.mark.parametrize("question", [0x91, ydlidar_wire.HEALTH])
def test_a_ydlidar_tells_its_health_by_the_old_command_and_the_new(question: int) -> None:
    lidar = YdlidarSim("x4", Sight(Standing(ROOM, POSE)))
    assert answer(lidar, ydlidar_wire.command(question)) == ydlidar_wire.answer(ydlidar_wire.HEALTH_TYPE, b"\0\0\0")
