"""One life of an open port: its rate is found, the device woken and its bytes fed to the driver, until the port is lost.

A stall (no reading for three periods, at least 0.3 s) restarts the stream; a second in a row ends the session.  A recording
has no rate, and a pause in it is none to mend: what was done about it then comes next.
"""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass

from hw.driver import Driver, Script
from hw.errors import DeviceAbsent, DeviceError, DeviceGarbled, DeviceSilent
from hw.health import DeviceState, StreamJudge
from hw.noticeboard import Noticeboard
from hw.port import Port
from hw.script_player import READ_WAIT_S, play, play_out

MIN_STALL_S, STALL_PERIODS = 0.3, 3.0  # HARDWARE.md: noticed within half a second
PROBE_S = 0.6  # how long a rate is listened to before the next one is tried
PROBE_BYTES = 4096  # no valid frame among so many: the rate or the device is another one
FIRST_READING_S = 5.0  # a motor needs 1-2 s to spin up
TRY_OTHERS_EVERY = 5  # a device that once answered at a rate is sought at the others only now and then


@dataclass(slots=True)
class KnownRate:
    """What is remembered of a device's rate from one session to the next."""

    baud: int = 0  # at which it last ran
    attempts: int = 0  # since then

    def to_try(self, bauds: tuple[int, ...]) -> list[int]:
        """The rates to try now."""
        self.attempts += 1
        return [self.baud] if self.baud and self.attempts % TRY_OTHERS_EVERY else list(bauds)

    def worked(self, baud: int) -> None:
        """The device runs at this rate."""
        self.baud, self.attempts = baud, 0


class Session:
    """From an open port to losing it.  `is_passive`: a recording; it speaks, and hears nothing."""

    def __init__(
        self, url: str, driver: Driver, port: Port, board: Noticeboard, stopping: threading.Event, is_passive: bool
    ) -> None:
        self._url, self._driver, self._port, self._board = url, driver, port, board
        self._stopping, self._is_passive = stopping, is_passive
        self._next_poll_s = 0.0
        self._is_gone = False  # the port failed: nothing can be written any more

    def run(self, rate: KnownRate) -> None:
        """Returns only when stopped, else raises."""
        try:
            self._bring_up(rate)
            self._stream()
        finally:
            if not self._is_gone and not self._is_passive:
                play_out(self._driver.stop(), self._port)

    def _bring_up(self, rate: KnownRate) -> None:
        """Try each rate until the device answers its start script and sends a first good frame."""
        bauds = [self._driver.bauds[0]] if self._is_passive else rate.to_try(self._driver.bauds)
        problems: list[DeviceError] = []
        for baud in bauds:
            if self._stopping.is_set():
                return
            self._board.note(state=DeviceState.PROBING)
            self._set_baud(baud)
            self._port.flush_input()
            self._driver.restart()
            try:
                frames = self._driver.counters.frames
                self._play(self._driver.start())
                self._first_frame(frames, PROBE_S if len(bauds) > 1 else FIRST_READING_S)
            except (DeviceSilent, DeviceGarbled) as error:
                problems.append(error)
                continue
            rate.worked(self._driver.baud)  # the script may have changed it
            return
        if problems:
            raise next((p for p in problems if isinstance(p, DeviceGarbled)), problems[0])

    def _first_frame(self, frames: int, listen_s: float) -> None:
        """Wait for a first good frame at this rate; say what was seen instead."""
        counters = self._driver.counters
        seen, begin_s = counters.bytes_in, time.monotonic()
        self._board.note(state=DeviceState.STARTING)
        while counters.frames == frames and not self._stopping.is_set():
            n, waited_s = counters.bytes_in - seen, time.monotonic() - begin_s
            if n > PROBE_BYTES or waited_s > (FIRST_READING_S if n else listen_s):
                self._raise_no_frame(n)
            self._pump(self._ask_if_due())

    def _raise_no_frame(self, n_bytes: int) -> None:
        if n_bytes == 0:
            raise DeviceSilent(
                f"{self._url}: nothing comes at {self._board.now.baud} baud; is it powered, and does the motor turn?"
            )
        rates = " or ".join(map(str, self._driver.bauds))
        raise DeviceGarbled(
            f"{self._url}: {n_bytes} bytes, no valid frame; is the baud rate {rates}, and is this really that device?"
        )

    def _stream(self) -> None:
        """Feed the driver until stopped; restart a stalled stream once, then give up the session."""
        self._board.begin_stream(time.monotonic())
        has_run, restarts = False, 0
        judge = StreamJudge(self._driver.counters)
        while not self._stopping.is_set():
            n = self._pump(self._ask_if_due())
            now_s = time.monotonic()
            if n:
                has_run, restarts = True, 0
                self._judge(judge, now_s)
            elif not self._is_passive and self._is_stalled(now_s, has_run):
                self._restart_stalled(restarts)
                restarts += 1
                self._board.forgive(time.monotonic())

    def _ask_if_due(self) -> float:
        """Poll a device that only answers; how long to wait for what comes."""
        period_s = self._driver.poll_period_s
        if period_s is None:
            return READ_WAIT_S
        now_s = time.monotonic()
        if now_s >= self._next_poll_s:
            self._port.write(self._driver.poll())
            self._next_poll_s = max(self._next_poll_s + period_s, now_s)
        return min(READ_WAIT_S, max(0.0, self._next_poll_s - now_s))

    def _is_stalled(self, now_s: float, has_run: bool) -> bool:
        """No byte for 0.3 s, or bytes but no reading for three periods."""
        silent_s, blind_s = now_s - self._board.last_bytes_s, now_s - self._board.last_reading_s
        if not has_run:
            return blind_s > FIRST_READING_S
        return silent_s > MIN_STALL_S or blind_s > max(MIN_STALL_S, STALL_PERIODS * self._driver.period_s)

    def _restart_stalled(self, restarts: int) -> None:
        """The stream stood still: start it again, the second time by opening the port anew."""
        message = f"{self._url}: the stream stands still; is the motor blocked, or the cable loose?"
        self._board.note(stalls=self._board.now.stalls + 1, state=DeviceState.STARTING, last_error=message)
        if restarts > 0:
            raise DeviceSilent(message)
        self._driver.restart()
        self._play(self._driver.start())

    def _judge(self, judge: StreamJudge, now_s: float) -> None:
        now = self._board.now
        state, error = judge.state(now_s, now.coverage), judge.error(self._url)
        if state is not now.state or (error and error != now.last_error):
            self._board.note(state=state, last_error=error or now.last_error)

    def _play(self, script: Script) -> None:
        """Carry out a driver's script; a recording hears nothing."""
        if not self._is_passive:
            play(script, self._port, self._pump, self._set_baud, self._stopping)

    def _pump(self, wait_s: float) -> int:
        """Move what has come to the driver and its readings to the board; how many readings there were."""
        gather_s = self._board.last_bytes_s + self._driver.gather_s - time.monotonic()
        if gather_s > 0:
            time.sleep(gather_s)
        try:
            data = self._port.read(wait_s)
        except DeviceAbsent:
            self._is_gone = True
            raise
        if not data:
            return 0
        now_s = time.monotonic()
        self._board.bytes_came(now_s, data)
        readings = self._driver.feed(data, now_s)
        for reading in readings:
            self._board.put(reading, now_s)
        return len(readings)

    def _set_baud(self, baud: int) -> None:
        self._port.set_baud(baud)
        self._driver.set_baud(baud)
        self._board.note(baud=baud)
