"""The table of LIDARs: URL scheme to driver.  All share the options `baud`, `range_min` and `range_max` (metres)."""

from __future__ import annotations

from collections.abc import Callable

from hw.driver import Driver
from hw.ld06 import MODELS as LDROBOT_MODELS
from hw.ld06 import Ld06
from hw.urls import DeviceUrl

COMMON = ("baud", "range_min", "range_max")


def _ldrobot(model: str) -> Callable[[DeviceUrl], Driver]:
    def build(url: DeviceUrl) -> Driver:
        url.only(COMMON)
        driver = Ld06(model)
        driver.limit(url.number("range_min", driver.range_min_m), url.number("range_max", driver.range_max_m))
        return driver

    return build


LIDARS: dict[str, Callable[[DeviceUrl], Driver]] = {
    **{model: _ldrobot(model) for model in LDROBOT_MODELS},
}
