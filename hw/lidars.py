"""The table of LIDARs: URL scheme to driver.  All share the options `baud`, `range_min` and `range_max` (metres)."""

from __future__ import annotations

from collections.abc import Callable

from hw.driver import Driver
from hw.ld06 import MODELS as LDROBOT_MODELS
from hw.ld06 import Ld06
from hw.rplidar import DEFAULT_PWM, DEFAULT_RPM, MODES, Rplidar
from hw.spinning import SpinningLidar
from hw.urls import DeviceUrl

COMMON = ("baud", "range_min", "range_max")


def _ldrobot(model: str) -> Callable[[DeviceUrl], Driver]:
    def build(url: DeviceUrl) -> Driver:
        url.only(COMMON)
        return _limited(Ld06(model), url)

    return build


def _rplidar(url: DeviceUrl) -> Driver:
    url.only((*COMMON, "mode", "rpm", "pwm"))
    mode = url.text_of("mode", "auto", ["auto", *MODES, *map(str, range(16))])
    rpm, pwm = url.integer("rpm", DEFAULT_RPM, 60, 1200), url.integer("pwm", DEFAULT_PWM, 1, 1023)
    return _limited(Rplidar(mode, rpm, pwm), url)


def _limited(driver: SpinningLidar, url: DeviceUrl) -> Driver:
    driver.limit(url.number("range_min", driver.range_min_m), url.number("range_max", driver.range_max_m))
    return driver


LIDARS: dict[str, Callable[[DeviceUrl], Driver]] = {
    **{model: _ldrobot(model) for model in LDROBOT_MODELS},
    "rplidar": _rplidar,
}
