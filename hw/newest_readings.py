"""The readings of a device that nobody fetched yet: bounded, and the newest win."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

from hw.driver import Reading
from hw.readings import LaserScan, Odometry

SCAN_SLOTS, ODOMETRY_SLOTS = 2, 512  # an old scan is worth nothing, old odometry is cheap


class NewestReadings:
    """A short queue; whoever shares it between threads holds a lock."""

    def __init__(self) -> None:
        self._readings: deque[Reading] = deque()

    def __len__(self) -> int:
        return len(self._readings)

    def pop(self) -> Reading | None:
        """The oldest."""
        return self._readings.popleft() if self._readings else None

    def push(self, reading: Reading) -> int:
        """Add the newest; how many old ones had to go."""
        slots = SCAN_SLOTS if isinstance(reading, LaserScan) else ODOMETRY_SLOTS
        dropped = 0
        while len(self._readings) >= slots:
            oldest = self._readings.popleft()
            dropped += 1
            if isinstance(oldest, Odometry) and oldest.is_discontinuity:
                self._keep_discontinuity()
        self._readings.append(reading)
        return dropped

    def _keep_discontinuity(self) -> None:
        """A discontinuity that nobody fetched moves on to the next sample: it must not be lost."""
        if self._readings and isinstance(self._readings[0], Odometry):
            self._readings[0] = replace(self._readings[0], is_discontinuity=True)
