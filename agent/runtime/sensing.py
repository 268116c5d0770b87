"""Devices to readings: one thread a device, and a place where the mapper picks up what came.

Odometry is small and every sample counts, so it waits in a long queue.  A scan is big and only the newest counts: when the
mapper is behind, the oldest waiting scan gives way and is counted as lost.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Protocol

from hw.readings import LaserScan, Odometry

MAX_SCANS_WAITING = 3  # at 10 Hz: the mapper may hiccup for 0.3 s before a scan is lost
MAX_ODOMETRY_WAITING = 4096  # 40 s at 100 Hz
READ_TIMEOUT_S = 0.25  # how long a read waits: short enough for a clean stop


class ReadingSource(Protocol):
    """What this room needs of a device (`hw.device`)."""

    def read(self, timeout_s: float) -> object | None: ...


class Readings:
    """Where the device threads put, and the map worker takes."""

    def __init__(self) -> None:
        self._came = threading.Condition()
        self._scans: deque[LaserScan] = deque()
        self._odometry: deque[Odometry] = deque(maxlen=MAX_ODOMETRY_WAITING)
        self.newest_odometry: Odometry | None = None
        self.scans_in = 0
        self.scans_lost = 0
        self.odometry_in = 0

    def put(self, reading: object) -> None:
        with self._came:
            if isinstance(reading, LaserScan):
                self.scans_in += 1
                if len(self._scans) >= MAX_SCANS_WAITING:
                    self._scans.popleft()
                    self.scans_lost += 1
                self._scans.append(reading)
            elif isinstance(reading, Odometry):
                self.odometry_in += 1
                self._odometry.append(reading)
                self.newest_odometry = reading
            self._came.notify()

    def take(self, timeout_s: float, wait_for_odometry_s: float) -> tuple[list[Odometry], LaserScan | None]:
        """All odometry so far and the oldest waiting scan.

        A scan waits a moment for the odometry of its own last beam, since motion within the revolution is undone with it.
        """
        with self._came:
            if not self._scans:
                self._came.wait_for(lambda: bool(self._scans), timeout_s)
            scan = self._scans.popleft() if self._scans else None
            if scan is not None:
                end_s = scan.stamp_s + scan.duration_s
                self._came.wait_for(
                    lambda: self.newest_odometry is None or self.newest_odometry.stamp_s >= end_s, wait_for_odometry_s
                )
            odometry = list(self._odometry)
            self._odometry.clear()
            return odometry, scan


def device_step(device: ReadingSource, readings: Readings, *, is_upside_down: bool = False) -> Callable[[], None]:
    """One step of a device's worker: wait a little for a reading and hand it on."""

    def step() -> None:
        reading = device.read(READ_TIMEOUT_S)
        if is_upside_down and isinstance(reading, LaserScan):
            reading = replace(reading, angles_rad=-reading.angles_rad)
        if reading is not None:
            readings.put(reading)

    return step
