"""Wheel bases on bad lines for hundreds of robot-hours: does a damaged byte ever become motion?

    .venv/bin/python -m tests.campaigns.wheel_torture --hours 100 --share 0.01 --kind bytes

A base drives a wide bend at constant wheel speeds; of its bytes the given share is lost or altered, one by one or in bursts, and
the driver gets what is left.  Between two readings that are not marked as a discontinuity the base cannot have moved further than
those speeds take it; 5 cm of excess are a teleport.  ros_arduino_bridge has no checksum, but answers each question twice.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np

from hw import arduino_bridge, create2, kobuki, roboclaw, wheels
from hw.odometry import BaseProtocol, WheelGeometry
from hw.wheel_driver import WheelDriver
from tests.bench.tables import markdown
from tests.harness.bad_line import damaged, how, options

FRAMES = (
    16384  # of one tile: 16-bit counters that grow by four or more a frame, and a clock of 20 ms, are then at their start again
)
TELEPORT_M = 0.05
PORTION = 8  # frames that are read at once
GEOMETRY = WheelGeometry(0.0005, 0.3, max_speed_mps=1.0)


@dataclass(frozen=True)
class Base:
    """A base, how it encodes its k-th frame, and how often."""

    protocol: Callable[[], BaseProtocol]
    frame: Callable[[int], bytes]  # of the k-th moment
    period_s: float
    steps: tuple[int, int]  # ticks a frame, left and right


BASES = {
    "wt1": Base(
        lambda: wheels.WheelBoard(GEOMETRY),
        lambda k: wheels.encode(wheels.EncoderFrame(k % 256, k * 20000 % 2**32, 8 * k, 12 * k)),
        0.02,
        (8, 12),
    ),
    "create2": Base(
        create2.Create2,
        lambda k: create2.encode_stream({43: 8 * k % 65536, 44: 12 * k % 65536}),
        0.015,
        (8, 12),
    ),
    "kobuki": Base(
        kobuki.Kobuki,
        lambda k: kobuki.encode(kobuki.Core(20 * k % 65536, 64 * k % 65536, 80 * k % 65536).encode()),
        0.02,
        (64, 80),
    ),
    "roboclaw": Base(lambda: roboclaw.RoboClaw(GEOMETRY), lambda k: roboclaw.encode_counts(0x80, 8 * k, 12 * k), 0.02, (8, 12)),
    "arduino-bridge": Base(
        lambda: arduino_bridge.ArduinoBridge(GEOMETRY),
        lambda k: arduino_bridge.TIMES_ASKED * arduino_bridge.encode_counts(12 * k, 16 * k),
        1 / 30,
        (12, 16),
    ),
}


@dataclass
class Tally:
    """What happened to one base."""

    base: str
    robot_hours: float = 0.0
    damaged_bytes: int = 0
    frames_sent: int = 0
    readings: int = 0
    discontinuities: int = 0
    teleports: int = 0
    worst_excess_m: float = 0.0
    cpu_s: float = 0.0


def main() -> int:
    args = options(__doc__, "bases", BASES).parse_args()
    tallies = [torture(name, args.hours, args.share, args.seed, args.kind) for name in args.only]
    print(json.dumps([asdict(tally) for tally in tallies], indent=2) if args.json else table(tallies, args.share, args.kind))
    return int(any(tally.teleports for tally in tallies))


def torture(name: str, hours: float, share: float, seed: int, kind: str) -> Tally:
    """One base on a bad line for so many hours."""
    base, tally = BASES[name], Tally(name)
    clean = np.frombuffer(b"".join(map(base.frame, range(FRAMES))), np.uint8)
    driver = WheelDriver(base.protocol(), name)
    metres = np.array(base.steps) * driver._protocol.geometry.metres_per_tick / base.period_s  # a second, of each wheel
    judge = Judge(float(metres.max()), PORTION * base.period_s, tally)
    rng = np.random.default_rng([seed, *name.encode()])
    tile_s = FRAMES * base.period_s
    begin_s = time.process_time()
    for tile in range(max(1, round(hours * 3600 / tile_s))):
        data, n_damaged = damaged(clean, kind, share, rng)
        size = math.ceil(len(data) * PORTION / FRAMES)
        for at in range(0, len(data), size):
            now_s = tile * tile_s + tile_s * min(1.0, (at + size) / len(data))
            for reading in driver.feed(data[at : at + size], now_s):
                judge.see(reading)
        tally.damaged_bytes += n_damaged
        tally.frames_sent += FRAMES
        tally.robot_hours += tile_s / 3600
    tally.cpu_s = round(time.process_time() - begin_s, 1)
    return tally


class Judge:
    """Holds each motion against the way the base can have gone since the reading before."""

    def __init__(self, speed_mps: float, slack_s: float, tally: Tally) -> None:
        self._speed_mps, self._slack_s, self._tally = speed_mps, slack_s, tally
        self._x_m = self._y_m = self._stamp_s = 0.0

    def see(self, odometry: object) -> None:
        """The next reading."""
        x_m, y_m, stamp_s = odometry.x_m, odometry.y_m, odometry.stamp_s  # type: ignore[attr-defined]
        tally = self._tally
        tally.readings += 1
        tally.discontinuities += odometry.is_discontinuity  # type: ignore[attr-defined]
        way_m = math.hypot(x_m - self._x_m, y_m - self._y_m)
        excess_m = way_m - self._speed_mps * (stamp_s - self._stamp_s + self._slack_s)
        tally.worst_excess_m = max(tally.worst_excess_m, round(excess_m, 4))
        tally.teleports += excess_m > TELEPORT_M
        self._x_m, self._y_m, self._stamp_s = x_m, y_m, stamp_s


def table(tallies: list[Tally], share: float, kind: str) -> str:
    """Markdown."""
    rows = [
        {
            "base": t.base,
            "robot-hours": f"{t.robot_hours:.1f}",
            "damaged bytes": f"{t.damaged_bytes:,}",
            "readings": f"{t.readings:,} ({t.readings / t.frames_sent:.0%})",
            "discontinuities": f"{t.discontinuities:,}",
            "teleports": t.teleports,
            "worst excess": f"{100 * t.worst_excess_m:.1f} cm",
            "CPU": f"{t.cpu_s:.0f} s",
        }
        for t in tallies
    ]
    return f"{how(share, kind)}\n\n{markdown(rows)}"


if __name__ == "__main__":
    raise SystemExit(main())
