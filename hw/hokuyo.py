"""Hokuyo URG, UBG, UTM: who it is, its laser, its scans in any mode, over USB or a serial line (SERIAL.md 4).

A stream (MD, MS, ME) is asked for once, single scans (GD, GS, GE) one by one.  A unit on RS-232 wakes slowly and is told to
speak faster; scans that its line cannot carry are left out.
"""

from __future__ import annotations

import math
import re

import numpy as np

from hw.byte_window import ByteWindow
from hw.clock import DeviceClock
from hw.driver import Ask, Drain, DriverBase, Pause, Reading, Script, Send, SetBaud
from hw.errors import DeviceError, DeviceSilent
from hw.readings import LaserScan
from hw.scan_assembler import supported_only
from hw.scip import (
    SCAN_ECHO,
    URG_04LX,
    UTM_30LX,
    Message,
    Parameters,
    ScanData,
    decode_message,
    fields_of,
    scan_bytes,
    scan_command,
    scan_of,
)
from hw.suspicion import Suspicion

CLOCK_PERIOD_S = 2**24 / 1e3
MOST_MESSAGE_BYTES = 16384  # ME of 1081 steps takes 6.9 kB
BOOT_TRIES = 20  # a UTM refuses to scan for a second or two after power-up


class Hokuyo(DriverBase):
    """Driver of the family.  `sees_nothing_as_free`: "nothing in range" becomes `inf`, else nothing is known there."""

    def __init__(self, mode: str = "MD", sees_nothing_as_free: bool = False, rate: int = 115200) -> None:
        super().__init__()
        self.identity.model = "Hokuyo"
        self.bauds = (115200, 19200, 57600, 500000, 250000, 750000)
        self.period_s = 0.1
        self.coverage = 0.0
        self.parameters: Parameters | None = None
        self._limits_m: tuple[float, float] | None = None
        self._mode, self._rate, self._sees_nothing_as_free = mode, rate, sees_nothing_as_free
        self._is_usb = True
        self._window = ByteWindow(self.counters, 4 * MOST_MESSAGE_BYTES)
        self._clock = DeviceClock(CLOCK_PERIOD_S)
        self._suspicion = Suspicion()
        self._answers: dict[bytes, Message] = {}
        self._command = b""

    @property
    def range_min_m(self) -> float:
        """Nearest range that is believed."""
        return self._limits_m[0] if self._limits_m else (self.parameters or UTM_30LX).range_min_mm / 1e3

    @property
    def range_max_m(self) -> float:
        """Farthest range that is believed."""
        return self._limits_m[1] if self._limits_m else (self.parameters or UTM_30LX).range_max_mm / 1e3

    def limit(self, range_min_m: float, range_max_m: float) -> None:
        """Believe only ranges within these limits."""
        self._limits_m = (range_min_m, range_max_m)

    def restart(self) -> None:
        """See `Driver.restart`."""
        self._window.clear()
        self._answers.clear()
        self._clock.restart()
        self.poll_period_s = None

    def start(self) -> Script:
        """Quiet, SCIP 2.0, who are you, laser on, scan."""
        yield Send(b"QT\n")
        yield Drain()
        yield Send(b"SCIP2.0\n")
        yield Drain()
        self.restart()
        told = yield self._ask(b"PP")
        if told is None:
            raise DeviceSilent("no answer to PP; is it a Hokuyo that speaks SCIP 2.0, and is it powered?")
        self.parameters = Parameters.parse(told.lines)
        if self.parameters is None:
            raise DeviceError(f"its parameters make no sense: {told.lines!r}")
        version = yield self._ask(b"VV")
        if version is not None:
            told_of = fields_of(version.lines)
            self.identity.serial, self.identity.firmware = told_of.get("SERI", ""), told_of.get("FIRM", "")
        self.identity.model = f"Hokuyo {self.parameters.model.split('(')[0].strip()}"
        yield from self._set_rate()
        yield from self._laser_on()
        yield from self._begin()

    def _set_rate(self) -> Script:
        """A serial line is made as fast as was asked for; the answer comes at the old rate."""
        state = yield self._ask(b"II")
        told = re.search(r"\d+", fields_of(state.lines).get("SBPS", "")) if state is not None else None
        self._is_usb = told is None
        if told is None or int(told[0]) == self._rate:
            return
        answer = yield self._ask(f"SS{self._rate:06d}".encode())
        if answer is None or answer.status not in (b"00", b"03"):
            return  # it stays as slow as it is
        yield SetBaud(self._rate)
        yield Pause(0.05)
        if (yield self._ask(b"VV")) is None:
            raise DeviceSilent(f"it agreed to {self._rate} baud and is not heard there; try ?rate=115200, or a better adapter")

    def _begin(self) -> Script:
        p = self.parameters
        assert p is not None
        turn_s = 60.0 / p.rpm
        sent_s = 0.0 if self._is_usb else 10.0 * scan_bytes(self._mode, p.last_step - p.first_step + 1) / self.baud
        skip = min(9, max(0, math.ceil(sent_s / turn_s) - 1))
        self.period_s = (skip + 1) * turn_s
        self._command = scan_command(self._mode, p.first_step, p.last_step, skip)
        if self._mode.startswith("M"):
            yield Send(self._command)
        else:
            self.poll_period_s = self.period_s

    def poll(self) -> bytes:
        """See `Driver.poll`: asks for one scan."""
        return self._command

    def _laser_on(self) -> Script:
        for _ in range(BOOT_TRIES):
            answer = yield self._ask(b"BM")
            if answer is None or answer.status in (b"00", b"02"):
                return
            if answer.status != b"10":
                break
            yield Pause(0.2)  # it is still starting
        status = answer.status.decode("ascii", "replace")
        raise DeviceError(f"the laser does not come on, status {status}; wait for its lamp, then unplug it and plug it in again")

    def stop(self) -> Script:
        """See `Driver.stop`."""
        yield Send(b"QT\n")

    def _ask(self, command: bytes, timeout_s: float = 0.5) -> Ask:
        self._answers.pop(command[:2], None)
        return Ask(command + b"\n", lambda: self._answers.get(command[:2]), timeout_s)

    def feed(self, data: bytes, now_s: float) -> list[Reading]:
        """Scans that these bytes complete; answers are kept for the script."""
        self._window.push(data.replace(b"\r\n", b"\n"))
        readings: list[Reading] = []
        while (end := self._window.data.find(b"\n\n")) >= 0:
            block = self._window.take(end + 2)[:-2].lstrip(b"\n")
            message = self._message(block) if block else None
            if message is None:
                continue
            scan = scan_of(message)
            if scan is not None:
                sent_s = 0.0 if self._is_usb else (len(block) + 2 + len(self._window)) * 10.0 / self.baud
                readings.append(self._scan(scan, now_s - sent_s))
            else:
                self._answers[message.echo[:2]] = message
        if len(self._window) > MOST_MESSAGE_BYTES:  # no message is that long: what is here cannot be one
            self._window.skip(len(self._window) - MOST_MESSAGE_BYTES)
        return readings

    def _message(self, block: bytes) -> Message | None:
        """The message in a block; when an end was lost and two ran together, the last of them."""
        message = decode_message(block)
        at = len(block)
        while message is None and (at := max(block.rfind(b"\nM", 0, at), block.rfind(b"\nG", 0, at))) >= 0:
            message = decode_message(block[at + 1 :]) if SCAN_ECHO.match(block[at + 1 : block.find(b"\n", at + 1)]) else None
        if message is None or (_has_scan(message) and scan_of(message) is None):
            self.counters.bad_frames += 1
            self.counters.skip(len(block) + 2)
            return None
        self.counters.skip(max(0, at + 1) if at < len(block) else 0)
        self._suspicion.note(self.counters.good())
        return message

    def _scan(self, scan: ScanData, arrived_s: float) -> LaserScan:
        p = self.parameters or (URG_04LX if scan.first_step + len(scan.values) * scan.cluster <= 800 else UTM_30LX)
        steps = scan.first_step + np.arange(len(scan.values)) * scan.cluster
        step_s = 60.0 / p.rpm / p.steps_per_turn
        sent_at_s = self._clock.to_host(scan.clock_ms / 1e3, arrived_s)  # the clock is read as the beam passes step 0
        first_s = sent_at_s - step_s * (p.last_step - scan.first_step)
        is_told = (scan.values >= p.range_min_mm) & (scan.values < scan.most_mm)
        metres = np.where(is_told, scan.values / 1e3, np.nan)
        with np.errstate(invalid="ignore"):
            metres = np.where((metres < self.range_min_m) | (metres > self.range_max_m), np.nan, metres)
        if self._sees_nothing_as_free:
            metres = np.where(scan.values == (1 if p.model.startswith("UTM") else 0), np.inf, metres)
        if self._suspicion:
            metres = supported_only(metres)
        self.coverage = 1.0
        offsets_s = ((steps - scan.first_step) * step_s).astype(np.float32)
        return LaserScan(
            stamp_s=first_s,
            ranges_m=metres.astype(np.float32),
            angles_rad=((steps - p.front_step) * (2 * np.pi / p.steps_per_turn)).astype(np.float32),
            range_min_m=self.range_min_m,
            range_max_m=self.range_max_m,
            duration_s=float(offsets_s[-1]),
            intensities=None if scan.intensities is None else scan.intensities.astype(np.float32),
            time_offsets_s=offsets_s,
            is_partial=False,
        )


def _has_scan(message: Message) -> bool:
    """Is this the answer that carries the scan, and not the one that accepts the request?"""
    return SCAN_ECHO.match(message.echo) is not None and len(message.lines) > 0
