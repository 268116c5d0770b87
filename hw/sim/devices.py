"""Devices that do not exist: what a robot in a simulated world, or in a recording, would send over its serial lines.

A `ByteDevice` is given the time and what the host wrote, and gives the bytes it has sent since it was last asked; it owns no
thread and no clock, so the same device is served through a pty, inside one process, or as fast as a test can read.
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from hw import ld06, sick_lms, wheels
from hw.sim.raycast import cast
from hw.sim.robot import SimulatedRobot
from protocol.geometry import SE2

LATE_S = 0.5  # a host that did not look for longer missed the rest: a serial line keeps nothing


class ByteDevice(Protocol):
    """One simulated device on a line."""

    @property
    def baud(self) -> int:
        """The rate it speaks at now; 0: any, as on USB."""
        ...

    def receive(self, data: bytes, now_s: float) -> None:
        """The host wrote this."""

    def emit(self, now_s: float) -> bytes:
        """What the device has sent up to now."""


class TickSource(Protocol):
    """What counts: a robot in a world or in a recording."""

    @property
    def info(self) -> wheels.InfoFrame: ...

    def sample(self, time_s: float) -> tuple[int, int, bool]:
        """Left ticks, right ticks, and whether the board restarted since the last sample."""


class Wt1Board:
    """A WT1 wheel board: encoder frames at a fixed rate, an info frame every second."""

    baud = 115200

    def __init__(self, source: TickSource, rate_hz: float = 50.0) -> None:
        self._source, self._period_s = source, 1.0 / rate_hz
        self._next_s: float | None = None
        self._first_s = 0.0
        self._sent = 0

    def receive(self, data: bytes, now_s: float) -> None:
        """The board takes no commands."""

    def emit(self, now_s: float) -> bytes:
        """See `ByteDevice`."""
        if self._next_s is None or now_s - self._next_s > LATE_S:
            self._next_s = now_s
            self._first_s = self._first_s or now_s
        out = bytearray()
        while self._next_s <= now_s:
            out += self._frames(self._next_s)
            self._next_s += self._period_s
        return bytes(out)

    def _frames(self, time_s: float) -> bytes:
        left, right, is_reset = self._source.sample(time_s)
        clock_us = round((time_s - self._first_s) * 1e6) % 2**32
        flags = wheels.FLAG_BOOT if is_reset else 0
        frame = wheels.encode(wheels.EncoderFrame(self._sent % 256, clock_us, _int32(left), _int32(right), flags))
        is_info_due = self._sent % max(1, round(1.0 / self._period_s)) == 0
        self._sent += 1
        return wheels.encode(self._source.info) + frame if is_info_due else frame


class RobotTicks:
    """`TickSource` of a simulated robot."""

    def __init__(self, robot: SimulatedRobot) -> None:
        self._robot = robot
        o = robot.options
        self.info = wheels.InfoFrame(
            round(o.ticks_per_revolution), round(o.wheel_radius_m * 1e6), round(o.track_m * 1e6), "simulated"
        )

    def sample(self, time_s: float) -> tuple[int, int, bool]:
        """See `TickSource`."""
        return (*self._robot.ticks_at(time_s), False)


class Ld06Lidar:
    """An LD06 family LIDAR on a simulated robot: each beam is measured from where the robot is at that very moment."""

    def __init__(
        self, robot: SimulatedRobot, model: str = "ld06", seed: int = 0, noise_m: float = 0.01, T_base_laser: SE2 | None = None
    ) -> None:
        self._robot, self._model, self._noise_m = robot, ld06.MODELS[model], noise_m
        self._T_base_laser = T_base_laser or SE2.identity()
        self.baud = self._model.baud
        self._rng = np.random.default_rng([31, seed])
        self._packet_s = ld06.BEAMS / self._model.samples_per_s
        self._next_s: float | None = None
        self._first_s = 0.0
        self._sent = 0

    def receive(self, data: bytes, now_s: float) -> None:
        """The LIDAR takes no commands."""

    def emit(self, now_s: float) -> bytes:
        """See `ByteDevice`: whole packets, each sent when its last beam is measured."""
        if self._next_s is None or now_s - self._next_s > LATE_S:
            self._next_s = now_s + self._packet_s
            self._first_s = self._first_s or now_s
        n = max(0, math.floor((now_s - self._next_s) / self._packet_s) + 1)
        if n == 0:
            return b""
        ends_s = self._next_s + self._packet_s * np.arange(n, dtype=np.float64)
        self._next_s += n * self._packet_s
        return self._packets(ends_s)

    def _packets(self, ends_s: NDArray[np.float64]) -> bytes:
        beam_s = 1.0 / self._model.samples_per_s
        before_s = beam_s * np.arange(ld06.BEAMS - 1, -1, -1, dtype=np.float64)
        times_s = (ends_s[:, None] - before_s).ravel()
        step_deg = 3600.0 / self._model.samples_per_s  # ten turns a second
        turn_deg = (self._sent * ld06.BEAMS + np.arange(len(times_s), dtype=np.float64)) * step_deg % 360.0
        self._sent += len(ends_s)
        mm = self._distances_mm(times_s, turn_deg).reshape(-1, ld06.BEAMS)
        cdeg = np.rint(turn_deg.reshape(-1, ld06.BEAMS) * 100).astype(int) % 36000
        out = bytearray()
        for k, end_s in enumerate(ends_s.tolist()):
            clock_ms = int((end_s - self._first_s) * 1e3) % 30000
            ends = int(cdeg[k, 0]), int(cdeg[k, -1])
            out += ld06.encode(ld06.Packet(3600, *ends, clock_ms, tuple(mm[k].tolist()), (200,) * ld06.BEAMS))
        return bytes(out)

    def _distances_mm(self, times_s: NDArray[np.float64], turn_deg: NDArray[np.float64]) -> NDArray[np.int64]:
        poses = self._robot.poses_at(times_s)
        c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        mount = self._T_base_laser
        origins = np.stack([poses[:, 0] + c * mount.x_m - s * mount.y_m, poses[:, 1] + s * mount.x_m + c * mount.y_m], axis=1)
        bearings = poses[:, 2] + mount.theta_rad - np.radians(turn_deg)  # the sensor turns clockwise
        ranges_m, _ = cast(self._robot.world.segments, origins, bearings, self._model.range_max_m)
        ranges_m = ranges_m + self._noise_m * self._rng.standard_normal(len(ranges_m))
        is_return = np.isfinite(ranges_m) & (ranges_m >= ld06.RANGE_MIN_M) & (ranges_m <= self._model.range_max_m)
        return np.where(is_return, np.rint(np.where(is_return, ranges_m, 0.0) * 1e3), 0).astype(np.int64)


class ScanSource(Protocol):
    """Scans in centimetres for a SICK, each at its moment."""

    def scans_until(self, now_s: float) -> list[list[int]]:
        """Scans that ended since the last call, 181 or 361 values from the right, 0x1FFF where nothing came back."""


class SickScanner:
    """A SICK LMS291 that answers the requests of a host and, once told to, sends each scan of its source."""

    baud = 500000

    def __init__(self, source: ScanSource) -> None:
        self._source = source
        self._inbox = bytearray()
        self._outbox = bytearray()
        self._is_sending = False

    def receive(self, data: bytes, now_s: float) -> None:
        """Answer every whole telegram in what the host wrote so far."""
        self._inbox += data
        del self._inbox[:-4096]
        while (start := self._inbox.find(sick_lms.STX)) >= 0 and len(self._inbox) >= start + 4:
            size = 6 + (self._inbox[start + 2] | self._inbox[start + 3] << 8)
            telegram = bytes(self._inbox[start : start + size])
            if len(telegram) < size <= 64:
                return
            decoded = sick_lms.decode(telegram) if size <= 64 else None
            del self._inbox[: start + (size if decoded else 1)]
            if decoded:
                self._outbox += bytes((sick_lms.ACK,)) + sick_lms.encode(self._answer(decoded[1]), sick_lms.SCANNER_ADDRESS)

    def _answer(self, payload: bytes) -> bytes:
        if payload == sick_lms.CONTINUOUS:
            self._is_sending = True
        elif payload == sick_lms.POLLED:
            self._is_sending = False
        if payload[0] == sick_lms.MODE:
            rates = {code: rate for rate, code in sick_lms.RATE_CODES.items()}
            self.baud = rates.get(payload[-1], self.baud) if len(payload) == 2 else self.baud  # from the answer on
            return b"\xa0\x00\x10"
        if payload[0] == sick_lms.VARIANT:
            return b"\xbb\x01" + payload[1:] + b"\x10"
        body = b"LMS291-S05;V02.10" if payload == sick_lms.TYPE else b""
        return bytes((payload[0] | 0x80,)) + body + b"\x10"

    def emit(self, now_s: float) -> bytes:
        """See `ByteDevice`."""
        out = bytes(self._outbox)
        self._outbox.clear()
        scans = self._source.scans_until(now_s) if self._is_sending else []
        return out + b"".join(sick_lms.scan_telegram(values) for values in scans)


def _int32(value: int) -> int:
    return (value + 2**31) % 2**32 - 2**31
