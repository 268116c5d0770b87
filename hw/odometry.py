"""Wheel counters to `Odometry`: one exact arc a sample, safe against wrap, bounded by what the base can do.

Every base protocol (`wheels`, `create2`, `kobuki`, `arduino_bridge`, `roboclaw`) decodes to `TickSample`; this file turns
samples into motion.  A counter delta is the shortest way round its ring, so 65530 -> 10 is +16 and 10 -> 65530 is -16.  A delta
that the base cannot have driven in the time is a reset, an unplugged encoder or corruption: it becomes a discontinuity,
never motion.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

from hw.byte_window import Counters
from hw.readings import Odometry
from protocol.geometry import SE2

SPEED_MARGIN = 1.5  # jitter of stamps: HARDWARE.md "bound v_max*dt*1.5"
MIN_STEP_S = 0.02  # frames that arrive in one burst share a stamp; one 50 Hz period is allowed for each
MAX_GAP_S = 1.0  # longer without a sample, a 16-bit counter may have wrapped unseen at full speed


@dataclass(frozen=True, slots=True)
class WheelGeometry:
    """What one tick is worth."""

    metres_per_tick: float
    track_m: float  # distance between the wheels
    max_speed_mps: float = 3.0  # of one wheel; above any small indoor base, far below a teleport

    @staticmethod
    def of_wheel(ticks_per_revolution: float, wheel_radius_m: float, track_m: float, max_speed_mps: float = 3.0) -> WheelGeometry:
        return WheelGeometry(math.tau * wheel_radius_m / ticks_per_revolution, track_m, max_speed_mps)


@dataclass(frozen=True, slots=True)
class TickSample:
    """One reading of both wheel counters, as the board sent it."""

    left_ticks: int
    right_ticks: int
    counter_bits: int  # width at which the counters wrap
    clock_s: float | None = None  # the board's own clock, wrapping at clock_period_s
    clock_period_s: float = 0.0
    is_reset: bool = False  # the board says that it restarted
    is_faulty: bool = False  # the board says that an encoder does not work


class BaseProtocol(Protocol):
    """Sans-I/O driver of a wheel base: what a serial thread sends, and what it makes of the answers."""

    baud_rates: tuple[int, ...]  # likeliest first
    geometry: WheelGeometry  # may change when the board tells its own
    poll_period_s: float  # send `poll_request()` this often; 0: the board streams by itself
    counters: Counters  # of its frames

    def start_requests(self) -> list[bytes]:
        """Sent once after opening, in order."""
        ...

    def stop_requests(self) -> list[bytes]: ...

    def poll_request(self) -> bytes: ...

    def feed(self, data: bytes) -> list[TickSample]: ...


class Quiet:
    """The part of a `BaseProtocol` that most bases share: nothing needs to be said to start, to stop or to be told."""

    poll_period_s = 0.0

    def start_requests(self) -> list[bytes]:
        """Nothing."""
        return []

    def stop_requests(self) -> list[bytes]:
        """Nothing: it never moved."""
        return []

    def poll_request(self) -> bytes:
        """Nothing: it streams by itself."""
        return b""


def tick_delta(before: int, after: int, bits: int) -> int:
    """Signed shortest way from one counter value to the next on a ring of 2**bits."""
    half = 1 << (bits - 1)
    return ((after - before + half) % (1 << bits)) - half


def arc(left_m: float, right_m: float, track_m: float) -> SE2:
    """Motion of the base when its wheels roll these distances at constant speeds: exact, not the midpoint rule."""
    turn_rad = (right_m - left_m) / track_m
    forward_m = (right_m + left_m) / 2
    if abs(turn_rad) < 1e-6:
        return SE2(forward_m, forward_m * turn_rad / 2, turn_rad)
    radius_m = forward_m / turn_rad
    return SE2(radius_m * math.sin(turn_rad), radius_m * (1 - math.cos(turn_rad)), turn_rad)


class TickIntegrator:
    """Chains samples of one base into the odometry frame."""

    def __init__(self, geometry: WheelGeometry) -> None:
        self.geometry = geometry
        self.discontinuities = 0
        self._pose = SE2.identity()
        self._last: TickSample | None = None
        self._last_stamp_s = 0.0

    def break_here(self) -> None:
        """The next sample starts anew: the port was closed and opened again."""
        self._last = None

    def add(self, sample: TickSample, stamp_s: float) -> Odometry:
        """The pose after this sample; marked as a discontinuity when the motion to it is not known."""
        motion = self._motion_to(sample, stamp_s)
        is_first, self._last, self._last_stamp_s = self._last is None, sample, stamp_s
        if motion is None:
            self.discontinuities += not is_first
            return Odometry(stamp_s, self._pose.x_m, self._pose.y_m, self._pose.theta_rad, is_discontinuity=True)
        self._pose = self._pose @ motion
        return Odometry(stamp_s, self._pose.x_m, self._pose.y_m, self._pose.theta_rad)

    def _motion_to(self, sample: TickSample, stamp_s: float) -> SE2 | None:
        last = self._last
        if last is None or sample.is_reset or sample.is_faulty or sample.counter_bits != last.counter_bits:
            return None
        elapsed_s = elapsed_clock_s(last, sample)
        if elapsed_s is None:
            elapsed_s = stamp_s - self._last_stamp_s
        if elapsed_s > MAX_GAP_S or stamp_s < self._last_stamp_s:
            return None
        left_m = self.geometry.metres_per_tick * tick_delta(last.left_ticks, sample.left_ticks, sample.counter_bits)
        right_m = self.geometry.metres_per_tick * tick_delta(last.right_ticks, sample.right_ticks, sample.counter_bits)
        bound_m = self.geometry.max_speed_mps * max(elapsed_s, MIN_STEP_S) * SPEED_MARGIN
        if max(abs(left_m), abs(right_m)) > bound_m:
            return None
        return arc(left_m, right_m, self.geometry.track_m)


def elapsed_clock_s(before: TickSample, after: TickSample) -> float | None:
    """Device time between two samples; None when the board has no clock.  A clock that ran backwards reads as a long gap."""
    if before.clock_s is None or after.clock_s is None or after.clock_period_s <= 0:
        return None
    return (after.clock_s - before.clock_s) % after.clock_period_s
