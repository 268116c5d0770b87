"""Every way to ask a Hokuyo for scans, over USB and over a slow serial line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hw import scip
from hw.device import open_lidar
from hw.hokuyo import Hokuyo
from hw.readings import LaserScan
from hw.sim.hokuyo_sim import HokuyoSim
from hw.sim.obedient import ObedientRobot
from hw.sim.sight import Sight
from tests.harness.serial_device import POSE, ROOM, SerialDevice, wall_errors_m
from tests.harness.waiting import first_reading


def scan_with(link: Path, name: str, options: str) -> LaserScan:
    with SerialDevice(name, link) as device, open_lidar(device.url + options) as lidar:
        scan = first_reading(lidar, lambda reading: isinstance(reading, LaserScan), 8.0)
        assert isinstance(scan, LaserScan)
        assert lidar.health().bad_frames == 0
    return scan


@pytest.mark.parametrize("mode", scip.MODES)
def test_a_hokuyo_measures_the_room_in_every_mode(mode: str, tmp_path: Path) -> None:
    scan = scan_with(tmp_path / "port", "hokuyo-urg", f"?mode={mode.lower()}")
    assert len(scan.ranges_m) == 682
    assert np.median(wall_errors_m(scan)) < 0.004
    assert (scan.intensities is not None) == mode.endswith("E")


def test_what_two_characters_cannot_say_is_no_wall_at_4095_mm() -> None:
    said = scip.encode_scan(b"MS0044072501000", 0, [4095] * 341 + [4094] * 341)
    (scan,) = Hokuyo("MS").feed(said, 1.0)
    assert isinstance(scan, LaserScan)
    assert np.isnan(scan.ranges_m[:341]).all() and scan.ranges_m[341:] == pytest.approx(4.094)


def test_a_hokuyo_on_a_slow_line_is_told_to_speak_faster_and_leaves_scans_out(tmp_path: Path) -> None:
    scan = scan_with(tmp_path / "port", "hokuyo-urg-rs232", "?rate=115200")
    assert np.median(wall_errors_m(scan)) < 0.004


class Host:
    """A host that asks a simulated Hokuyo, as fast as it likes."""

    def __init__(self, baud: int = 0) -> None:
        self.sim = HokuyoSim(scip.URG_04LX, Sight(ObedientRobot(ROOM, POSE), noise_m=0.0), baud)
        self.now_s = 10.0

    def ask(self, command: str) -> scip.Message:
        """The first answer to a command."""
        self.sim.receive(command.encode() + b"\n", self.now_s)
        self.now_s += 0.3
        message = scip.decode_message(self.sim.emit(self.now_s).split(b"\n\n")[0])
        assert message is not None and message.echo == command.encode()
        return message


def test_a_simulated_hokuyo_says_in_which_state_it_is() -> None:
    host = Host()
    story = ("TM0", 2), ("TM2", 0), ("BM", 3), ("MD0044072501000", 4), ("QT", 0)
    for command, state in story:
        assert host.ask(command).status == b"00"
        assert host.ask("%ST").lines == (b"%03d" % state,)


@pytest.mark.parametrize(("command", "status"), [
    ("GD0044072501", b"10"), ("MD0044072601000", b"04"), ("MD0100004401000", b"05"),
    ("TM1", b"04"), ("SS123456", b"04"), ("XY", b"0E"),
])  # fmt: skip
def test_a_simulated_hokuyo_refuses_what_cannot_be(command: str, status: bytes) -> None:
    assert Host().ask(command).status == status


def test_a_new_bit_rate_holds_from_behind_the_answer_that_grants_it() -> None:
    host = Host(baud=19200)
    assert host.ask("SS115200").status == b"00"
    assert host.sim.baud == 19200
    host.sim.emit(host.now_s)
    assert host.sim.baud == 115200
    assert host.ask("SS115200").status == b"03"
