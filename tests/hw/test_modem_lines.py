"""The motor of an RPLIDAR A1 hangs on DTR; a port with modem lines is met over RFC 2217."""

from __future__ import annotations

import numpy as np
import pytest

from hw.device import open_lidar
from hw.readings import LaserScan
from hw.sim.obedient import ObedientRobot
from hw.sim.rplidar_sim import RplidarSim
from hw.sim.sight import Sight
from tests.harness.modem_lines import ModemLines
from tests.harness.serial_device import POSE, ROOM, wall_errors_m
from tests.harness.waiting import first_reading


@pytest.mark.filterwarnings("ignore:set(Daemon|Name):DeprecationWarning")  # pyserial's own
def test_the_motor_of_an_a1_turns_while_it_is_read_and_rests_afterwards() -> None:
    with ModemLines(RplidarSim("rplidar-a1", Sight(ObedientRobot(ROOM, POSE), noise_m=0.0))) as port:
        with open_lidar(f"rplidar:{port.url}?baud=115200") as lidar:
            scan = first_reading(lidar, lambda reading: isinstance(reading, LaserScan), 10.0)
            assert not port.dtr, "DTR lowered: the motor turns"
        assert port.dtr, "DTR raised: the motor rests"
    assert np.median(wall_errors_m(scan)) < 0.004
    assert port.changes[0] is False, "the port is opened with DTR down, so that a motor that turns is not stopped"


def test_an_a1_whose_motor_is_stopped_sends_no_beams() -> None:
    lidar = RplidarSim("rplidar-a1", Sight(ObedientRobot(ROOM, POSE)))
    lidar.receive(b"\xa5\x20", 1.0)
    assert len(lidar.emit(1.4)) > 1000
    lidar.set_lines(dtr=True, rts=True, now_s=1.4)
    assert lidar.emit(1.8) == b""
    lidar.set_lines(dtr=False, rts=True, now_s=1.8)
    assert len(lidar.emit(2.2)) > 1000
