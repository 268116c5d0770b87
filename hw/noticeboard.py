"""What a device shows: its readings nobody fetched yet, and how it is.  Its own thread writes, any other may read."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from hw.driver import Driver, Reading
from hw.health import DeviceHealth, DeviceState, RateMeter
from hw.newest_readings import NewestReadings
from hw.readings import LaserScan

STAMPS = 20  # so many readings tell the rate
Tap = Callable[[float, bytes], None]


class Noticeboard:
    """Of one device."""

    def __init__(self, url: str, port_name: str, driver: Driver) -> None:
        self._driver = driver
        self._health = DeviceHealth(url, DeviceState.DISCONNECTED, port_name)
        self._readings = NewestReadings()
        self._changed = threading.Condition()
        self._stamps: deque[float] = deque(maxlen=STAMPS)
        self._rates = RateMeter()
        self._is_closed = False
        self._begun_s = 0.0  # when the stream last started
        self.last_reading_s = self.last_bytes_s = 0.0  # or when that was last forgiven
        self.tap: Tap | None = None  # sees every byte that is fed, with its time: the recorder

    @property
    def now(self) -> DeviceHealth:
        """As it was noted last, without what `health` works out."""
        return self._health

    def open(self) -> None:
        """Readings may be waited for."""
        self._is_closed = False

    def close(self) -> None:
        """Nobody need wait any longer."""
        self._is_closed = True
        with self._changed:
            self._changed.notify_all()

    def note(self, **facts: Any) -> None:
        """Change what is said of the device."""
        with self._changed:
            self._health = replace(self._health, **facts)

    def begin_stream(self, now_s: float) -> None:
        """From now on bytes and readings are due."""
        self._begun_s = now_s
        self.forgive(now_s)

    def forgive(self, now_s: float) -> None:
        """Silence counts from now on."""
        self.last_reading_s = self.last_bytes_s = now_s

    def bytes_came(self, now_s: float, data: bytes) -> None:
        """These are about to be fed."""
        self.last_bytes_s = now_s
        if self.tap is not None:
            self.tap(now_s, data)
        self._rates.add(now_s, len(data))

    def put(self, reading: Reading, now_s: float) -> None:
        """A reading for whoever asks next."""
        with self._changed:
            dropped = self._readings.push(reading)
            self._stamps.append(now_s)
            self.last_reading_s = now_s
            facts: dict[str, Any] = {"readings": self._health.readings + 1, "dropped": self._health.dropped + dropped}
            if isinstance(reading, LaserScan):
                facts |= {"points": len(reading.ranges_m), "coverage": getattr(self._driver, "coverage", 1.0)}
            self._health = replace(self._health, **facts)
            self._changed.notify_all()

    def read(self, timeout_s: float) -> Reading | None:
        """The oldest reading not yet fetched, waiting up to `timeout_s`; None when there is none."""
        with self._changed:
            self._changed.wait_for(lambda: len(self._readings) > 0 or self._is_closed, timeout_s)
            return self._readings.pop()

    def health(self) -> DeviceHealth:
        """How the device is doing now."""
        now_s = time.monotonic()
        with self._changed:
            health, stamps = self._health, list(self._stamps)
            counters, identity = self._driver.counters, self._driver.identity
        is_up = health.state in (DeviceState.RUNNING, DeviceState.DEGRADED)
        rate_hz = (len(stamps) - 1) / (stamps[-1] - stamps[0]) if is_up and len(stamps) > 1 and stamps[-1] > stamps[0] else 0.0
        return replace(
            health,
            model=identity.model,
            serial=identity.serial,
            firmware=identity.firmware,
            uptime_s=now_s - self._begun_s if is_up else 0.0,
            age_s=now_s - self.last_reading_s if self.last_reading_s else float("inf"),
            rate_hz=rate_hz,
            bytes_per_s=self._rates.bytes_per_s(now_s),
            bad_frames=counters.bad_frames,
            skipped_bytes=counters.skipped_bytes,
            rejected=counters.rejected,
            resyncs=counters.resyncs,
        )
