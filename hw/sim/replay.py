"""A recording as a robot that drives again: its scans from a SICK, its raw wheel motion from a WT1 board.

Recorded scans lie up to a metre apart, so time is compressed, and the robot stops for each scan:

    scan i-1        turn    drive    turn        scan i
    --- still ---|-------|--------|-------|--- still ---        `STILL_S` around every scan, so a late byte costs nothing

Any planar motion is a turn, a straight drive and a turn; the board reports exactly at the borders of these phases, so that
integrating its ticks as arcs gives back the recorded motion to the width of a tick.
"""

from __future__ import annotations

import math
import threading
from bisect import bisect_right

import numpy as np
from numpy.typing import NDArray

from hw import wheels
from hw.carmen import RecordedScan, Recording
from protocol.geometry import SE2, wrap_angle

STILL_S = 0.08
STOP_S = 0.004  # after a phase the board says once more where it stands, so that nobody extrapolates its last speed
SPEED_MPS, TURN_RAD_S = 2.5, 3.5  # at speed 1: within what any mapper takes for motion
TICKS_PER_REVOLUTION, WHEEL_RADIUS_UM, TRACK_UM = 60000, 50_000, 300_000
NOTHING_CM = 0x1FFF


class Replay:
    """When each scan is taken and how far each wheel has rolled; time starts with `begin`."""

    def __init__(self, recording: Recording, speed: float = 1.0) -> None:
        self.recording = recording
        self._begun_s: float | None = None
        self._lock = threading.Lock()
        self.scan_times_s: list[float] = []
        self.event_times_s: list[float] = []
        self.event_rolled_m: list[tuple[float, float]] = []
        self.reset_times_s: set[float] = set()
        self._schedule(speed)

    def begin(self, now_s: float) -> None:
        """Start the clock; the first call counts."""
        with self._lock:
            self._begun_s = now_s if self._begun_s is None else self._begun_s

    @property
    def duration_s(self) -> float:
        return self.scan_times_s[-1] + STILL_S

    def elapsed_s(self, now_s: float) -> float:
        """Seconds since `begin`; negative before."""
        return -1.0 if self._begun_s is None else now_s - self._begun_s

    def _schedule(self, speed: float) -> None:
        now_s, rolled = STILL_S, np.zeros(2)
        for i, scan in enumerate(self.recording.scans):
            if i > 0:
                for duration_s, step in phases(self.recording.laser_motion(scan), speed):
                    now_s, rolled = now_s + duration_s, rolled + step
                    self._event(now_s, rolled)
                if scan.motion is None:
                    self.reset_times_s.add(now_s)
                self._event(now_s + STOP_S, rolled)
                now_s += STILL_S / 2
            self.scan_times_s.append(now_s)
            now_s += STILL_S / 2
            self._event(now_s, rolled)

    def _event(self, time_s: float, rolled_m: NDArray[np.float64]) -> None:
        self.event_times_s.append(time_s)
        self.event_rolled_m.append((float(rolled_m[0]), float(rolled_m[1])))


def phases(motion: SE2, speed: float) -> list[tuple[float, NDArray[np.float64]]]:
    """(seconds, [left, right] metres) of a turn, a straight drive and a turn that together are this motion."""
    distance_m = math.hypot(motion.x_m, motion.y_m)
    first_rad = math.atan2(motion.y_m, motion.x_m) if distance_m > 1e-4 else 0.0
    if abs(first_rad) > math.pi / 2:  # backwards is shorter than turning round
        first_rad, distance_m = wrap_angle(first_rad + math.pi), -distance_m
    half_m = TRACK_UM * 1e-6 / 2
    result = []
    for turn_rad, straight_m in ((first_rad, 0.0), (0.0, distance_m), (wrap_angle(motion.theta_rad - first_rad), 0.0)):
        seconds = max(0.004, abs(turn_rad) / (TURN_RAD_S * speed), abs(straight_m) / (SPEED_MPS * speed))
        result.append((seconds, np.array([straight_m - half_m * turn_rad, straight_m + half_m * turn_rad])))
    return result


class ReplayBoard:
    """The WT1 board of a replay (a `ByteDevice`): one frame at every border of a phase, an info frame every second."""

    baud = 115200

    def __init__(self, replay: Replay) -> None:
        self._replay = replay
        self._info = wheels.InfoFrame(TICKS_PER_REVOLUTION, WHEEL_RADIUS_UM, TRACK_UM, "recording")
        self._next = 0
        self._sent = 0
        self._next_idle_s = -math.inf

    def receive(self, data: bytes, now_s: float) -> None:
        """The board takes no commands."""

    def emit(self, now_s: float) -> bytes:
        """See `ByteDevice`; the board says where it stands even when nothing moves."""
        elapsed_s = self._replay.elapsed_s(now_s)
        due = bisect_right(self._replay.event_times_s, elapsed_s)
        out = b"".join(self._frame(k, now_s - elapsed_s) for k in range(self._next, due))
        self._next = due
        if out:
            self._next_idle_s = now_s + 0.1
        elif now_s >= self._next_idle_s:
            self._next_idle_s = now_s + 0.1
            is_between_phases = 0 < due < len(self._replay.event_times_s)
            out = b"" if is_between_phases else self._idle(now_s)
        return out

    def _idle(self, now_s: float) -> bytes:
        rolled = self._replay.event_rolled_m[-1] if self._next else (0.0, 0.0)
        return self._encoded(now_s, rolled, is_reset=False)

    def _frame(self, k: int, begun_s: float) -> bytes:
        time_s = self._replay.event_times_s[k]
        return self._encoded(begun_s + time_s, self._replay.event_rolled_m[k], time_s in self._replay.reset_times_s)

    def _encoded(self, time_s: float, rolled_m: tuple[float, float], is_reset: bool) -> bytes:
        per_metre = TICKS_PER_REVOLUTION / (math.tau * WHEEL_RADIUS_UM * 1e-6)
        left, right = (round(metres * per_metre) for metres in rolled_m)
        flags = wheels.FLAG_BOOT if is_reset else 0
        frame = wheels.encode(wheels.EncoderFrame(self._sent % 256, round(time_s * 1e6) % 2**32, left, right, flags))
        is_info_due = self._sent % 20 == 0
        self._sent += 1
        return wheels.encode(self._info) + frame if is_info_due else frame


class ReplayScans:
    """The scans of a replay, for a `SickScanner`."""

    def __init__(self, replay: Replay) -> None:
        self._replay = replay
        self._next = 0

    def scans_until(self, now_s: float) -> list[list[int]]:
        """See `ScanSource`."""
        due = bisect_right(self._replay.scan_times_s, self._replay.elapsed_s(now_s))
        scans = [sick_values(scan) for scan in self._replay.recording.scans[self._next : due]]
        self._next = due
        return scans


def sick_values(scan: RecordedScan) -> list[int]:
    """Centimetres at 1 or 0.5 degree from the right: 181 or 361 values, `NOTHING_CM` where nothing came back."""
    n = 181 if len(scan.ranges_m) <= 181 else 361
    step_rad = math.pi / (n - 1)
    index = np.rint((scan.angles_rad + math.pi / 2) / step_rad).astype(int)
    is_good = np.isfinite(scan.ranges_m) & (index >= 0) & (index < n) & (scan.ranges_m < 80.0)
    values = np.full(n, NOTHING_CM)
    values[index[is_good]] = np.rint(scan.ranges_m[is_good] * 100).astype(int)
    return [int(v) for v in values]
