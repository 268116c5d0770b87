"""Carries out a driver's script on its port, step by step (`hw/driver.py` says what the steps mean)."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

from hw.driver import Ask, Drain, Pause, Script, Send, SetBaud, SetLines
from hw.errors import DeviceError
from hw.port import Port

READ_WAIT_S = 0.05  # so soon everything that waits for bytes sees that it is to stop

Pump = Callable[[float], object]  # waits so long for bytes and feeds the driver what has come


def play(script: Script, port: Port, pump: Pump, set_baud: Callable[[int], None], stopping: threading.Event) -> None:
    """Play it to its end, or until stopped."""
    answer: Any = None
    while not stopping.is_set():
        try:
            step = script.send(answer)
        except StopIteration:
            return
        answer = None
        if isinstance(step, Send):
            port.write(step.data)
        elif isinstance(step, Ask):
            answer = _ask(step, port, pump, stopping)
        elif isinstance(step, Drain):
            answer = _drain(step, port, stopping)
        elif isinstance(step, Pause):
            _pause(step, pump, stopping)
        elif isinstance(step, SetLines):
            port.set_lines(step.dtr, step.rts)
        elif isinstance(step, SetBaud):
            set_baud(step.baud)


def play_out(script: Script, port: Port) -> None:
    """Send what stops the device, without listening: used when leaving, so it must not take long or fail."""
    try:
        for step in script:
            if isinstance(step, Send | Ask):
                port.write(step.data)
            elif isinstance(step, SetLines):
                port.set_lines(step.dtr, step.rts)
            elif isinstance(step, Pause):
                time.sleep(min(step.seconds, 0.05))
    except DeviceError:
        return


def _ask(step: Ask, port: Port, pump: Pump, stopping: threading.Event) -> object:
    port.write(step.data)
    deadline_s = time.monotonic() + step.timeout_s
    while (answer := step.until()) is None and not stopping.is_set():
        left_s = deadline_s - time.monotonic()
        if left_s <= 0:
            return None
        pump(min(left_s, READ_WAIT_S))
    return answer


def _drain(step: Drain, port: Port, stopping: threading.Event) -> bool:
    deadline_s = time.monotonic() + step.max_s
    while time.monotonic() < deadline_s and not stopping.is_set():
        if not port.read(step.quiet_s):
            return True
    return False


def _pause(step: Pause, pump: Pump, stopping: threading.Event) -> None:
    deadline_s = time.monotonic() + step.seconds
    while (left_s := deadline_s - time.monotonic()) > 0 and not stopping.is_set():
        pump(min(left_s, READ_WAIT_S))
