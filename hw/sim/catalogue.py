"""Every simulated device by the name people know it by, for `mapquilt sim`."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

from hw import create2, kobuki, wheels, xv11
from hw.sim.arduino_sim import ArduinoBridgeSim
from hw.sim.bases_sim import Counter, Counting, Wt1Ticks
from hw.sim.create2_sim import Create2Sim
from hw.sim.devices import ByteDevice, Wt1Board
from hw.sim.hokuyo_sim import MODELS as HOKUYOS
from hw.sim.hokuyo_sim import HokuyoSim
from hw.sim.kobuki_sim import KobukiSim
from hw.sim.roboclaw_sim import RoboClawSim
from hw.sim.robot import DriveOptions
from hw.sim.rplidar_sim import RplidarSim
from hw.sim.rplidar_units import UNITS
from hw.sim.sick_sim import SickSim
from hw.sim.sight import Sight
from hw.sim.spinning_sim import LdrobotSim, NeatoSim
from hw.sim.ydlidar_sim import YDLIDARS, YdlidarSim

USUAL = DriveOptions()


@dataclass(frozen=True, slots=True)
class BaseKind:
    """A wheel base and the drive it sits on."""

    make: Callable[[Counter], ByteDevice]
    drive: DriveOptions
    url: str  # scheme, and the options a driver needs


def _drive(metres_per_tick: float, track_m: float, radius_m: float) -> DriveOptions:
    return replace(USUAL, track_m=track_m, wheel_radius_m=radius_m, ticks_per_revolution=math.tau * radius_m / metres_per_tick)


def _wt1(counter: Counter) -> ByteDevice:
    o = USUAL
    radius_um, track_um = round(o.wheel_radius_m * 1e6), round(o.track_m * 1e6)
    return Wt1Board(Wt1Ticks(counter, wheels.InfoFrame(round(o.ticks_per_revolution), radius_um, track_um, "simulated")))


_GIVEN = f"?ticks={USUAL.ticks_per_revolution}&radius={USUAL.wheel_radius_m}&track={USUAL.track_m}"
BASES = {
    "wt1": BaseKind(_wt1, USUAL, "wheels:{}"),
    "create2": BaseKind(
        lambda counter: Create2Sim(Counting(counter)), _drive(create2.METRES_PER_TICK, create2.TRACK_M, 0.036), "create2:{}"
    ),
    "kobuki": BaseKind(
        lambda counter: KobukiSim(Counting(counter)),
        _drive(kobuki.GEOMETRY.metres_per_tick, kobuki.GEOMETRY.track_m, 0.035),
        "kobuki:{}",
    ),
    "arduino-bridge": BaseKind(lambda counter: ArduinoBridgeSim(Counting(counter)), USUAL, "arduino:{}" + _GIVEN),
    "roboclaw": BaseKind(lambda counter: RoboClawSim(Counting(counter)), USUAL, "roboclaw:{}" + _GIVEN),
}

LIDARS: dict[str, tuple[Callable[[Sight], ByteDevice], str]] = {
    **{name: (partial(RplidarSim, name), "rplidar:{}") for name in UNITS},
    **{name: (partial(LdrobotSim, name), f"{name}:{{}}") for name in ("ld06", "ld19", "stl27l")},
    **{f"ydlidar-{name}": (partial(YdlidarSim, name), f"ydlidar:{{}}?model={name}") for name in YDLIDARS},
    **{name: (partial(HokuyoSim, parameters), "hokuyo:{}") for name, parameters in HOKUYOS.items()},
    "hokuyo-urg-rs232": (partial(HokuyoSim, HOKUYOS["hokuyo-urg"], baud=19200), "hokuyo:{}"),
    "sick-lms291": (SickSim, "sick:{}"),
    "xv11": (partial(NeatoSim, xv11.XV11), "xv11:{}"),
    "lds01": (partial(NeatoSim, xv11.LDS01), "lds01:{}"),
}

NAMES = (*LIDARS, *BASES)


def device_url(name: str, path: object) -> str:
    """What `mapquilt run` is told to use the device `name` at this path."""
    return (LIDARS[name][1] if name in LIDARS else BASES[name].url).format(path)
