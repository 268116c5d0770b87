"""When a device measured something, in this computer's monotonic time.

Bytes arrive late, never early.  So the smallest difference between arrival and the device's own clock is the true offset
between the two, and it is followed by a line that sinks at once and rises slowly, by no more than a crystal drifts.
"""

from __future__ import annotations

DRIFT = 200e-6  # worst crystal pair of SERIAL.md section 8
LOST_S = 0.5  # further back, or further ahead of its arrival: the device was restarted or its clock was damaged on the line
CATCHING_UP_S = 1.0  # a reader that stood still has read what waited for it within this; who is late for longer runs anew


class DeviceClock:
    """Lower envelope of arrival minus device time, for a clock that wraps at `period_s`."""

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._unwrapped_s = 0.0
        self._arrival_s = 0.0
        self._late_since_s: float | None = None
        self._offset_s: float | None = None

    def restart(self) -> None:
        """The device's clock may have begun anew."""
        self._offset_s = None

    def to_host(self, device_s: float, arrival_s: float) -> float:
        """Host time at which a message stamped `device_s` could have arrived earliest: arrival without the delays."""
        if self._offset_s is None:
            return self._begin(device_s, arrival_s)
        risen_s = self._offset_s + DRIFT * max(0.0, arrival_s - self._arrival_s)
        expected_s, half_s = arrival_s - risen_s, self._period_s / 2
        late_s = half_s - (device_s - expected_s + half_s) % self._period_s
        unwrapped_s = expected_s - late_s
        if unwrapped_s < self._unwrapped_s - LOST_S or not self._is_plausible(late_s, arrival_s):
            return self._begin(device_s, arrival_s)
        self._offset_s = risen_s + min(0.0, late_s)
        self._unwrapped_s, self._arrival_s = unwrapped_s, arrival_s
        return unwrapped_s + self._offset_s

    def _is_plausible(self, late_s: float, arrival_s: float) -> bool:
        """Not from the future, and late for a moment only."""
        if late_s <= LOST_S:
            self._late_since_s = None
            return late_s >= -LOST_S
        self._late_since_s = arrival_s if self._late_since_s is None else self._late_since_s
        return arrival_s - self._late_since_s <= CATCHING_UP_S

    def _begin(self, device_s: float, arrival_s: float) -> float:
        self._late_since_s = None
        self._unwrapped_s, self._arrival_s, self._offset_s = device_s, arrival_s, arrival_s - device_s
        return arrival_s
