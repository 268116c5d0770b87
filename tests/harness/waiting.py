"""Waiting for what a device says, with a deadline, and how long a deadline is on a machine that is busy."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from hw.device import Source


def first_reading(device: Source, is_wanted: Callable[[Any], bool], seconds: float) -> Any:
    """The first reading that is wanted; an AssertionError that tells the device's health when none comes in time."""
    deadline_s = time.monotonic() + seconds
    while time.monotonic() < deadline_s:
        reading = device.read(0.1)
        if reading is not None and is_wanted(reading):
            return reading
    raise AssertionError(f"no such reading within {seconds} s: {device.health()}")


def until(holds: Callable[[], object], seconds: float = 15.0, what: str = "it") -> float:
    """Seconds until `holds()`; an AssertionError when it does not in time."""
    begun_s = time.monotonic()
    while not holds():
        if time.monotonic() > begun_s + seconds:
            raise AssertionError(f"{what} did not happen within {seconds} s")
        time.sleep(0.005)
    return time.monotonic() - begun_s


def slowness(work_s: float = 0.05) -> float:
    """How much longer work takes here and now than its processor time: 1 on a quiet machine."""
    began_s, spent_s = time.monotonic(), time.thread_time()
    while time.thread_time() - spent_s < work_s:
        pass
    return max(1.0, (time.monotonic() - began_s) / work_s)
