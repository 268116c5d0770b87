"""When a device measured something, in this computer's monotonic time.

Bytes arrive late, never early.  So the smallest difference between arrival and the device's own clock is the true offset
between the two, and it is followed by a line that sinks at once and rises slowly, by no more than a crystal drifts.
"""

from __future__ import annotations

DRIFT = 200e-6  # worst crystal pair of SERIAL.md section 8
LOST_S = 0.5  # further apart, the device was restarted or its clock was damaged on the line


class DeviceClock:
    """Lower envelope of arrival minus device time, for a clock that wraps at `period_s`."""

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._unwrapped_s = 0.0
        self._arrival_s = 0.0
        self._offset_s: float | None = None

    def restart(self) -> None:
        """The device's clock may have begun anew."""
        self._offset_s = None

    def to_host(self, device_s: float, arrival_s: float) -> float:
        """Host time at which a message stamped `device_s` could have arrived earliest: arrival without the delays."""
        if self._offset_s is None:
            return self._begin(device_s, arrival_s)
        elapsed_s = arrival_s - self._arrival_s
        expected_s = self._unwrapped_s + elapsed_s
        half_s = self._period_s / 2
        unwrapped_s = expected_s + (device_s - expected_s + half_s) % self._period_s - half_s
        if abs(unwrapped_s - expected_s) > LOST_S:
            return self._begin(device_s, arrival_s)
        risen_s = self._offset_s + DRIFT * max(0.0, elapsed_s)
        self._offset_s = min(risen_s, arrival_s - unwrapped_s)
        self._unwrapped_s, self._arrival_s = unwrapped_s, arrival_s
        return unwrapped_s + self._offset_s

    def _begin(self, device_s: float, arrival_s: float) -> float:
        self._unwrapped_s, self._arrival_s, self._offset_s = device_s, arrival_s, arrival_s - device_s
        return arrival_s
