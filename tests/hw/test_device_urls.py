"""A device URL opens what it says, or says in one sentence why not."""

from __future__ import annotations

import pytest

from hw.device import build_driver, open_lidar, open_wheels, schemes
from hw.errors import DeviceConfigError
from hw.hokuyo import Hokuyo
from hw.rplidar import Rplidar
from hw.sick_lms import SickLms
from hw.urls import parse_url
from hw.ydlidar import YdLidar


@pytest.mark.parametrize("scheme", schemes("lidar"))
def test_every_lidar_opens_with_the_common_options(scheme: str) -> None:
    driver = build_driver(parse_url(f"{scheme}:/dev/ttyUSB0?baud=57600&range_min=0.2&range_max=5"), "lidar")
    assert driver.bauds == (57600,)
    assert (driver.range_min_m, driver.range_max_m) == (0.2, 5.0)


def test_options_reach_their_driver() -> None:
    rplidar = build_driver(parse_url("rplidar:/dev/x?mode=dense&rpm=700"), "lidar")
    assert isinstance(rplidar, Rplidar) and (rplidar._mode, rplidar._rpm) == ("dense", 700)
    ydlidar = build_driver(parse_url("ydlidar:/dev/x?model=g4b&intensity=10"), "lidar")
    assert isinstance(ydlidar, YdLidar) and ydlidar.bauds == (512000,)
    sick = build_driver(parse_url("sick:/dev/x?rate=500000&step=0.5"), "lidar")
    assert isinstance(sick, SickLms) and sick.bauds[0] == 500000
    assert isinstance(build_driver(parse_url("hokuyo:/dev/x?intensity=1&free=1"), "lidar"), Hokuyo)


@pytest.mark.parametrize(
    ("url", "says"),
    [
        ("ld06", "is no device URL"),
        ("ld07:/dev/ttyUSB0", "is no kind of lidar; there are"),
        ("ld06:", "which port? for example ld06:/dev/ttyUSB0"),
        ("ld06:/dev/x?boud=115200", "did you mean 'baud'?"),
        ("ld06:/dev/x?baud=fast", "must be a number"),
        ("ld06:/dev/x?baud=1.5e3.1", "must be a number"),
        ("ld06:/dev/x?baud=9600.5", "whole number"),
        ("rplidar:/dev/x?mode=turbo", "must be one of auto, standard"),
        ("ld06:/dev/x?baud", "options are written"),
        ("wheels:/dev/ttyACM0", "it is a wheel base: --wheels wheels"),
    ],
)
def test_a_wrong_url_says_what_is_wrong(url: str, says: str) -> None:
    with pytest.raises(DeviceConfigError, match=says.replace("?", r"\?")):
        open_lidar(url)


def test_a_lidar_is_no_base() -> None:
    with pytest.raises(DeviceConfigError, match="it is a LIDAR: --lidar ld06"):
        open_wheels("ld06:/dev/ttyUSB0")
    with pytest.raises(DeviceConfigError, match="radius, track missing"):
        open_wheels("wheels:/dev/ttyACM0?ticks=1000")
