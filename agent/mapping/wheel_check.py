"""Do the wheels tell what the scans show?  A track or a wheel radius that is wrong in the settings shows in every metre.

Over stretches of a metre or half a radian, what matching added to the wheels' way is laid against that way:

    added_m   = length * way_m                            the radius is wrong
    added_rad = turn * turned_rad + drift * way_m         the track is wrong; one wheel is larger than the other

Least squares over the last few hundred stretches, each older one counting a little less.  What these three do not explain
is slip.  A figure is as sure as its own standard error says; in a corridor without features lengths are not looked at.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protocol.geometry import SE2

STRETCH_M, STRETCH_RAD = 1.0, 0.5
FORGETTING = 0.995  # per stretch: 200 of them remain, so that new tyres are noticed within the quarter of an hour
FEWEST_STRETCHES = 25
SURE = 4.0  # standard errors
LENGTH_WORTH_SAYING = 0.03  # of the way: what a ruler on the floor finds; less, matching makes up for
TURN_WORTH_SAYING = 0.04  # of the turn
DRIFT_WORTH_SAYING = math.radians(5.0)  # a metre
SLIP_WORTH_SAYING = math.radians(3.5)  # over a metre; wheels on office floor have half of it


@dataclass(frozen=True, slots=True)
class WheelFigures:
    """What the wheels tell against what the scans show, with one standard error each."""

    length: float  # metres shown per metre told, less one
    length_error: float
    turn: float  # radians shown per radian told, less one
    turn_error: float
    drift_rad_m: float  # radians shown and not told per metre
    drift_error_rad_m: float
    slip_rad: float  # one sigma over a metre of what is left
    stretches: int

    def sentences(self) -> Iterator[str]:
        """What a person should know, and what to set."""
        length = self.length if is_sure(self.length, self.length_error, LENGTH_WORTH_SAYING) else 0.0
        if length:
            yield (
                f"the wheels tell {compared(length, 'shorter', 'longer')} ways than the scans show: the wheel radius or the ticks"
                f" per revolution are wrong; set wheels.wheel_radius_m to {1.0 + length:.3f} of what it is"
            )
        if is_sure(self.turn, self.turn_error, TURN_WORTH_SAYING):
            track = (1.0 + length) / (1.0 + self.turn)
            yield (
                f"the wheels tell {compared(self.turn, 'smaller', 'larger')} turns than the scans show: wrong track width,"
                f" wheel radius or slip; "
                + (
                    f"set wheels.track_m to {track:.3f} of what it is"
                    if abs(track - 1.0) > 0.01
                    else "the right wheel radius corrects it, too"
                )
            )
        if is_sure(self.drift_rad_m, self.drift_error_rad_m, DRIFT_WORTH_SAYING):
            side, other = ("left", "right") if self.drift_rad_m > 0.0 else ("right", "left")
            yield (
                f"the robot bends {abs(math.degrees(self.drift_rad_m)):.0f} degrees a metre to the {side} of where its wheels"
                f" say: the {other} wheel is larger than the {side} one, or the {side} one drags; change the wheels over to see"
            )
        if self.slip_rad > SLIP_WORTH_SAYING:
            yield (
                f"the wheels slip: over a metre their heading is {math.degrees(self.slip_rad):.1f} degrees off, now to one side,"
                " now to the other; long corridors may come out bent: check tyres and floor, drive slower"
            )


def is_sure(value: float, error: float, worth_saying: float) -> bool:
    return abs(value) > max(worth_saying, SURE * error)


def compared(value: float, less: str, more: str) -> str:
    return f"{abs(value):.0%} {less if value > 0.0 else more}"


class WheelCheck:
    """Sums over stretches of way.  All of its state is `sums` and `stretch`, two arrays for the checkpoint."""

    def __init__(self) -> None:
        self.stretch = np.zeros(
            7
        )  # way_m, added_m, turned_rad, added_rad, absolute way_m and turned_rad, 1 when lengths are open
        self.sums = np.zeros(13)  # see _sum_up

    def add(self, told: SE2, added: SE2, is_open: bool) -> None:
        """One scan's step: what the wheels told, and what matching added to it (in the robot frame)."""
        step = (told.x_m, added.x_m, told.theta_rad, added.theta_rad, abs(told.x_m), abs(told.theta_rad))
        self.stretch[:6] += step
        self.stretch[6] = max(self.stretch[6], float(is_open))
        if self.stretch[4] >= STRETCH_M or self.stretch[5] >= STRETCH_RAD:
            self._sum_up()
            self.break_off()

    def break_off(self) -> None:
        """The present stretch tells nothing: a wheel spun, or the robot was carried."""
        self.stretch = np.zeros(7)

    def _sum_up(self) -> None:
        way_m, added_m, turned, added, distance_m, _, is_open = self.stretch.tolist()
        lengths = [0.0] * 4 if is_open else [1.0, way_m * way_m, way_m * added_m, added_m * added_m]
        turns = [1.0, turned * turned, turned * way_m, way_m * way_m, turned * added, way_m * added, added * added]
        self.sums = FORGETTING * self.sums + np.array([*lengths, *turns, distance_m, 1.0])

    def figures(self) -> WheelFigures | None:
        """None until there is enough to say anything."""
        n, xx, xy, yy, m, tt, tw, ww, ta, wa, aa, distance_m, _ = self.sums.tolist()
        if m < FEWEST_STRETCHES or distance_m <= 0.0:
            return None
        length, length_error = (
            (xy / xx, math.sqrt(max(yy - xy * xy / xx, 0.0) / (n - 1.0) / xx)) if n > 2.0 and xx > 0.0 else (0.0, math.inf)
        )
        normal: NDArray[np.float64] = np.array([[tt, tw], [tw, ww]]) + 1e-9 * np.eye(2)
        right = np.array([ta, wa])
        turn, drift = np.linalg.solve(normal, right).tolist()
        left = max(aa - turn * ta - drift * wa, 0.0) / (m - 2.0)
        turn_error, drift_error = np.sqrt(left * np.diag(np.linalg.inv(normal))).tolist()
        return WheelFigures(length, length_error, turn, turn_error, drift, drift_error, math.sqrt(left * m / distance_m), int(m))
