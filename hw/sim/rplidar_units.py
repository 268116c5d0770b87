"""RPLIDARs that are simulated: what each tells of itself, its line, and its list of scan modes.

One or two stand for each generation: the A1 at 115200 baud with the express mode, the A3 and the S1 at 256000 with ultra and
dense capsules, the C1 at 460800, the S2 and the S3 at a million baud with 3200 beams a turn.
"""

from __future__ import annotations

from dataclasses import dataclass

from hw import rplidar_wire as wire

TURN_HZ = 10.0


@dataclass(frozen=True, slots=True)
class Mode:
    """One entry of the list of scan modes."""

    name: str
    type: int
    samples_per_s: int


@dataclass(frozen=True, slots=True)
class Unit:
    """One model of the family."""

    info: wire.Info
    baud: int
    range_max_m: float
    modes: tuple[Mode, ...]
    typical: int
    turn_hz: float = TURN_HZ
    has_pwm: bool = False  # an accessory board drives the motor


def _info(model: int, firmware: tuple[int, int], hardware: int) -> wire.Info:
    return wire.Info(model, firmware, hardware, bytes(range(model, model + 16)))


UNITS = {
    "rplidar-a1": Unit(
        _info(0x18, (1, 29), 7),
        115200,
        12.0,
        (
            Mode("Standard", wire.NODE_TYPE, 2000),
            Mode("Express", wire.EXPRESS_TYPE, 4000),
            Mode("Boost", wire.ULTRA_TYPE, 7680),
        ),
        typical=1,
        turn_hz=5.0,
    ),
    "rplidar-a3": Unit(
        _info(0x31, (1, 29), 6),
        256000,
        25.0,
        (
            Mode("Standard", wire.NODE_TYPE, 4000),
            Mode("Express", wire.EXPRESS_TYPE, 8000),
            Mode("Boost", wire.ULTRA_TYPE, 16000),
            Mode("Sensitivity", wire.ULTRA_TYPE, 16000),
            Mode("Stability", wire.ULTRA_TYPE, 10000),
        ),
        typical=3,
        has_pwm=True,
    ),
    "rplidar-s1": Unit(
        _info(0x61, (1, 28), 18),
        256000,
        40.0,
        (Mode("Standard", wire.NODE_TYPE, 4100), Mode("DenseBoost", wire.DENSE_TYPE, 9200)),
        typical=1,
    ),
    "rplidar-c1": Unit(
        _info(0x41, (1, 2), 18),
        460800,
        12.0,
        (Mode("Standard", wire.NODE_TYPE, 5000), Mode("DenseBoost", wire.DENSE_TYPE, 5000)),
        typical=1,
    ),
    "rplidar-s2": Unit(
        _info(0x71, (1, 1), 18),
        1000000,
        30.0,
        (
            Mode("Standard", wire.NODE_TYPE, 8000),
            Mode("DenseBoost", wire.DENSE_TYPE, 32000),
            Mode("UltraDense", wire.ULTRA_DENSE_TYPE, 32000),
        ),
        typical=1,
    ),
    "rplidar-s3": Unit(
        _info(0x81, (1, 2), 18),
        1000000,
        40.0,
        (
            Mode("Standard", wire.NODE_TYPE, 8000),
            Mode("DenseBoost", wire.DENSE_TYPE, 16000),
            Mode("UltraDense", wire.ULTRA_DENSE_TYPE, 32000),
        ),
        typical=2,
    ),
}
