"""Without settings, a robot takes what answers on its serial ports."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import SimpleNamespace

import pytest

from agent.commands import plugged_in
from agent.config import Config, WheelsConfig
from agent.exits import ENVIRONMENT, USAGE, CommandError
from hw.probing import SerialPortInfo


@dataclass
class Desk:
    """Ports, who sits at each, and which were asked."""

    ports: list[SerialPortInfo]
    answers: Mapping[str, tuple[str, str]]  # device -> (scheme, kind)
    asked: list[str]

    def probe(self, device: str) -> object | None:
        self.asked.append(device)
        if device not in self.answers:
            return None
        scheme, kind = self.answers[device]
        return SimpleNamespace(url=f"{scheme}:{device}", kind=kind, health=SimpleNamespace(model=scheme.upper()))


@pytest.fixture
def desk(monkeypatch: pytest.MonkeyPatch) -> Desk:
    ports = [SerialPortInfo(f"/dev/ttyUSB{i}", by_path=f"/dev/serial/by-path/usb-{i}") for i in range(4)]
    desk = Desk(ports, {"/dev/ttyUSB1": ("kobuki", "wheels"), "/dev/ttyUSB2": ("ld06", "lidar")}, [])
    monkeypatch.setattr(plugged_in, "serial_ports", lambda: desk.ports)
    monkeypatch.setattr(plugged_in, "probe", desk.probe)
    return desk


def test_the_first_lidar_and_the_first_base_are_taken_by_the_names_that_stay(desk: Desk) -> None:
    config = plugged_in.with_what_is_plugged_in(Config())
    assert config.lidar.url == "ld06:/dev/serial/by-path/usb-2"
    assert config.wheels.url == "kobuki:/dev/serial/by-path/usb-1"
    assert desk.asked == ["/dev/ttyUSB0", "/dev/ttyUSB1", "/dev/ttyUSB2"]  # nobody else is disturbed


def test_ports_in_use_and_the_base_that_was_named_are_left_alone(desk: Desk) -> None:
    desk.ports[0] = SerialPortInfo("/dev/ttyUSB0", used_by="gpsd")
    config = plugged_in.with_what_is_plugged_in(Config(wheels=WheelsConfig(url="wheels:/dev/ttyUSB1")))
    assert config.wheels.url == "wheels:/dev/ttyUSB1"
    assert desk.asked == ["/dev/ttyUSB2"]


def test_a_robot_without_a_base_maps_with_its_lidar_alone(desk: Desk) -> None:
    desk.answers = {"/dev/ttyUSB3": ("rplidar", "lidar")}
    config = plugged_in.with_what_is_plugged_in(Config())
    assert (config.lidar.url, config.wheels.url) == ("rplidar:/dev/serial/by-path/usb-3", "")


def test_nobody_there_is_told(desk: Desk) -> None:
    desk.answers = {}
    with pytest.raises(CommandError, match="no LIDAR answered on /dev/ttyUSB0, /dev/ttyUSB1") as caught:
        plugged_in.with_what_is_plugged_in(Config())
    assert caught.value.code == ENVIRONMENT
    desk.ports = []
    with pytest.raises(CommandError, match="try --lidar sim:office") as caught:
        plugged_in.with_what_is_plugged_in(Config())
    assert caught.value.code == USAGE
