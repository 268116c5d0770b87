"""The table of LIDARs: URL scheme to driver.  All share the options `baud`, `range_min` and `range_max` (metres)."""

from __future__ import annotations

from collections.abc import Callable

from hw import scip
from hw.driver import Driver
from hw.hokuyo import Hokuyo
from hw.ld06 import MODELS as LDROBOT_MODELS
from hw.ld06 import Ld06
from hw.rplidar import Rplidar
from hw.rplidar_start import DEFAULT_PWM, DEFAULT_RPM, MODES
from hw.sick_lms import SickLms
from hw.sick_wire import RATE_CODES
from hw.spinning import SpinningLidar
from hw.urls import DeviceUrl
from hw.xv11 import LDS01, XV11, Kind, Xv11
from hw.ydlidar import YdLidar
from hw.ydlidar_wire import MODELS as YDLIDAR_MODELS

COMMON = ("baud", "range_min", "range_max")
Build = Callable[[DeviceUrl], Driver]


def _ldrobot(model: str) -> Build:
    def build(url: DeviceUrl) -> Driver:
        url.only(COMMON)
        return _limited(Ld06(model), url)

    return build


def _rplidar(url: DeviceUrl) -> Driver:
    url.only((*COMMON, "mode", "rpm", "pwm"))
    mode = url.text_of("mode", "auto", ["auto", *MODES, *map(str, range(16))])
    rpm, pwm = url.integer("rpm", DEFAULT_RPM, 60, 1200), url.integer("pwm", DEFAULT_PWM, 1, 1023)
    return _limited(Rplidar(mode, rpm, pwm), url)


def _ydlidar(url: DeviceUrl) -> Driver:
    url.only((*COMMON, "model", "intensity"))
    model = url.text_of("model", "auto", ["auto", *YDLIDAR_MODELS])
    bits = url.text_of("intensity", "auto", ["auto", "0", "8", "10", "16"])
    return _limited(YdLidar(None if model == "auto" else model, None if bits == "auto" else int(bits)), url)


def _hokuyo(url: DeviceUrl) -> Driver:
    url.only((*COMMON, "mode", "intensity", "free", "rate"))
    usual = "me" if url.integer("intensity", 0, 0, 1) else "md"
    mode = url.text_of("mode", usual, [mode.lower() for mode in scip.MODES]).upper()
    rate = int(url.text_of("rate", "115200", map(str, scip.RATES)))
    return _limited(Hokuyo(mode, url.integer("free", 0, 0, 1) == 1, rate), url)


def _sick(url: DeviceUrl) -> Driver:
    url.only((*COMMON, "rate", "step"))
    rate = int(url.text_of("rate", "38400", map(str, RATE_CODES)))
    step = url.text_of("step", "as-is", ["as-is", "0.25", "0.5", "1"])
    return _limited(SickLms(rate, None if step == "as-is" else float(step)), url)


def _neato(kind: Kind) -> Build:
    def build(url: DeviceUrl) -> Driver:
        url.only(COMMON)
        return _limited(Xv11(kind), url)

    return build


def _limited(driver: SpinningLidar | Hokuyo | SickLms, url: DeviceUrl) -> Driver:
    if "range_min" in url.options or "range_max" in url.options:
        driver.limit(url.number("range_min", driver.range_min_m), url.number("range_max", driver.range_max_m))
    return driver


LIDARS: dict[str, Build] = {
    **{model: _ldrobot(model) for model in LDROBOT_MODELS},
    "rplidar": _rplidar,
    "ydlidar": _ydlidar,
    "hokuyo": _hokuyo,
    "sick": _sick,
    "xv11": _neato(XV11),
    "lds01": _neato(LDS01),
}
