"""What `mapquilt scan` shows of a wheel base: where its wheels say it is, a line a second."""

from __future__ import annotations

import json
import math
import time

from hw.device import Source
from hw.health import DeviceHealth
from hw.readings import Odometry


class WheelTeller:
    """Prints readings: all of them as JSON, or one a second for a person."""

    def __init__(self, is_json: bool) -> None:
        self._is_json = is_json
        self._told_s = 0.0
        self._way_m = 0.0
        self._jumps = -1  # the first reading is one
        self._last: Odometry | None = None

    def tell(self, odometry: Odometry, device: Source) -> None:
        """The next reading."""
        if odometry.is_discontinuity or self._last is None:
            self._jumps += 1
        else:
            self._way_m += math.hypot(odometry.x_m - self._last.x_m, odometry.y_m - self._last.y_m)
        self._last = odometry
        if self._is_json:
            print(json.dumps(self._figures(odometry, device.health())), flush=True)
        elif time.monotonic() - self._told_s >= 1.0:
            self._told_s = time.monotonic()
            print(self._line(self._figures(odometry, device.health()), device.health().model), flush=True)

    def _figures(self, odometry: Odometry, health: DeviceHealth) -> dict[str, object]:
        return {
            "stamp_s": round(odometry.stamp_s, 4),
            "state": health.state.value,
            "rate_hz": round(health.rate_hz, 2),
            "x_m": round(odometry.x_m, 4),
            "y_m": round(odometry.y_m, 4),
            "heading_deg": round(math.degrees(odometry.theta_rad), 2),
            "way_m": round(self._way_m, 3),
            "jumps": self._jumps,
            "bad_frames": health.bad_frames,
        }

    def _line(self, facts: dict[str, object], model: str) -> str:
        return (
            f"{model:<20} {facts['state']:<8} {facts['rate_hz']:5.1f} Hz  x {facts['x_m']:7.3f} m  y {facts['y_m']:7.3f} m  "
            f"heading {facts['heading_deg']:6.1f} deg  {facts['way_m']:.2f} m driven  {facts['jumps']} jumps"
        )
