"""A device that is kept alive: one thread opens its port, wakes it, feeds its driver, and starts again whatever happens.

    DISCONNECTED -> PROBING (which rate, who is it) -> STARTING (motor, first reading) -> RUNNING <-> DEGRADED
         ^                                                                                   |
         +------------- back-off 50 ms, doubled to 2 s, for ever <---- pulled, silent -------+

A stall (no reading for three periods, at least 0.3 s) restarts the stream, the second in a row reopens the port.  A device
fault never leaves `read()` as an exception: it is None, and `health()` says why.
"""

from __future__ import annotations

import os
import random
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from hw.driver import Driver, Reading, Script
from hw.errors import DeviceAbsent, DeviceError, DeviceGarbled, DeviceSilent
from hw.health import DeviceHealth, DeviceState, RateMeter, StreamJudge
from hw.newest_readings import NewestReadings
from hw.port import Port
from hw.readings import LaserScan
from hw.script_player import READ_WAIT_S, play, play_out

FIRST_BACK_OFF_S, LAST_BACK_OFF_S = 0.05, 2.0  # a replugged cable is back within a second; a missing one costs nothing
SILENT_BACK_OFF_S = 0.4  # the port is there, the device says nothing: it may speak again any moment
MIN_STALL_S, STALL_PERIODS = 0.3, 3.0  # HARDWARE.md: noticed within half a second
PROBE_S = 0.6  # how long a rate is listened to before the next one is tried
PROBE_BYTES = 4096  # no valid frame among so many: the rate or the device is another one
FIRST_READING_S = 5.0  # a motor needs 1-2 s to spin up
TRY_OTHERS_EVERY = 5  # a device that once answered at a rate is sought at the others only now and then


OpenPort = Callable[[int, bool | None], Port]  # (baud, level of DTR while opening)


class Device:
    """One supervised device.  `read` may be called from any one thread; `health` from any."""

    def __init__(
        self,
        url: str,
        driver: Driver,
        open_port: OpenPort,
        port_name: str = "",
        rng: random.Random | None = None,
        is_passive: bool = False,
    ) -> None:
        self._url, self._driver, self._open_port = url, driver, open_port
        self._rng = rng or random.Random()
        self.tap: Callable[[float, bytes], None] | None = None  # sees every byte that is fed, with its time: the recorder
        self._is_passive = is_passive  # a recording: it speaks, and hears nothing
        self._readings = NewestReadings()
        self._arrived = threading.Condition()
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None
        self._port: Port | None = None
        self._health = DeviceHealth(url, DeviceState.DISCONNECTED, port_name)
        self._running_since_s = self._last_reading_s = 0.0
        self._stamps: deque[float] = deque(maxlen=20)
        self._rates = RateMeter()
        self._last_bytes_s = 0.0
        self._good_baud = 0  # the rate at which the device last ran
        self._attempts = 0  # since then
        self._next_poll_s = 0.0
        self._is_gone = False  # the port failed: nothing can be written any more

    def start(self) -> Device:
        """Begin; returns at once, the device comes up in the background."""
        if self._thread is None:
            self._stopping.clear()
            self._thread = threading.Thread(target=self._run, name=f"device {self._url}", daemon=True)
            self._thread.start()
        return self

    def stop(self) -> None:
        """Stop the device (motor too) and close its port; returns within about a second."""
        self._stopping.set()
        port = self._port
        if port is not None:
            port.wake()
        if self._thread is not None:
            self._thread.join(timeout=3.0)
            self._thread = None
        with self._arrived:
            self._arrived.notify_all()

    def __enter__(self) -> Device:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.stop()

    def read(self, timeout_s: float) -> Reading | None:
        """The oldest reading not yet fetched, waiting up to `timeout_s`; None when there is none."""
        with self._arrived:
            self._arrived.wait_for(lambda: len(self._readings) > 0 or self._stopping.is_set(), timeout_s)
            return self._readings.pop()

    def health(self) -> DeviceHealth:
        """How the device is doing now."""
        now_s = time.monotonic()
        with self._arrived:
            health, stamps = self._health, list(self._stamps)
            counters, identity = self._driver.counters, self._driver.identity
        is_up = health.state in (DeviceState.RUNNING, DeviceState.DEGRADED)
        rate_hz = (len(stamps) - 1) / (stamps[-1] - stamps[0]) if is_up and len(stamps) > 1 and stamps[-1] > stamps[0] else 0.0
        return replace(
            health,
            model=identity.model,
            serial=identity.serial,
            firmware=identity.firmware,
            uptime_s=now_s - self._running_since_s if is_up else 0.0,
            age_s=now_s - self._last_reading_s if self._last_reading_s else float("inf"),
            rate_hz=rate_hz,
            bytes_per_s=self._rates.bytes_per_s(now_s),
            bad_frames=counters.bad_frames,
            skipped_bytes=counters.skipped_bytes,
            rejected=counters.rejected,
            resyncs=counters.resyncs,
        )

    def _run(self) -> None:
        """Open, run, fail, wait, again; until stopped."""
        back_off_s = FIRST_BACK_OFF_S
        while not self._stopping.is_set():
            before = self._health.readings
            most_s = LAST_BACK_OFF_S
            try:
                self._session()
            except DeviceError as error:
                most_s = SILENT_BACK_OFF_S if isinstance(error, DeviceSilent) else LAST_BACK_OFF_S
                self._failed(str(error))
            except Exception as error:  # a bug of ours must not silence a robot's eyes
                self._failed(f"internal error {error!r}; please report this")
            finally:
                self._close()
            if self._health.readings > before:
                back_off_s = FIRST_BACK_OFF_S
            self._wait_to_retry(min(back_off_s, most_s) * self._rng.uniform(0.8, 1.2))
            back_off_s = min(2 * back_off_s, LAST_BACK_OFF_S)
            self._note(reconnects=self._health.reconnects + (not self._stopping.is_set()))
        self._note(state=DeviceState.DISCONNECTED)

    def _failed(self, why: str) -> None:
        scheme, _, _ = self._url.partition(":")
        if self._health.port and why.startswith(self._health.port):
            why = f"{scheme}:{why}"
        elif not why.startswith(self._url):
            why = f"{self._url}: {why}"
        self._note(state=DeviceState.DISCONNECTED, last_error=why)

    def _wait_to_retry(self, seconds: float) -> None:
        """Wait; not longer than until a port that was missing is there again."""
        path = self._health.port
        was_missing = path.startswith("/") and not os.path.exists(path)
        deadline_s = time.monotonic() + seconds
        while (left_s := deadline_s - time.monotonic()) > 0 and not self._stopping.is_set():
            if was_missing and os.path.exists(path):
                return
            self._stopping.wait(min(left_s, READ_WAIT_S))

    def _session(self) -> None:
        """From opening the port to losing the device; returns only when stopped, else raises."""
        driver = self._driver
        self._is_gone = False
        self._port = self._open_port(self._good_baud or driver.bauds[0], driver.open_dtr)
        try:
            self._bring_up(self._port)
            self._stream()
        finally:
            if not self._is_gone and not self._is_passive:
                play_out(driver.stop(), self._port)

    def _bring_up(self, port: Port) -> None:
        """Try each rate until the device answers its start script and sends a first good frame."""
        self._attempts += 1
        bauds = [self._good_baud] if self._good_baud and self._attempts % TRY_OTHERS_EVERY else list(self._driver.bauds)
        problems: list[DeviceError] = []
        for baud in bauds:
            if self._stopping.is_set():
                return
            self._note(state=DeviceState.PROBING)
            self._set_baud(baud)
            port.flush_input()
            self._driver.restart()
            try:
                frames = self._driver.counters.frames
                self._play(self._driver.start())
                self._first_frame(frames, PROBE_S if len(bauds) > 1 else FIRST_READING_S)
            except (DeviceSilent, DeviceGarbled) as error:
                problems.append(error)
                continue
            self._good_baud, self._attempts = self._driver.baud, 0  # the script may have changed it
            return
        if problems:
            raise next((p for p in problems if isinstance(p, DeviceGarbled)), problems[0])

    def _first_frame(self, frames: int, listen_s: float) -> None:
        """Wait for a first good frame at this rate; say what was seen instead."""
        counters = self._driver.counters
        seen, begin_s = counters.bytes_in, time.monotonic()
        self._note(state=DeviceState.STARTING)
        while counters.frames == frames and not self._stopping.is_set():
            n, waited_s = counters.bytes_in - seen, time.monotonic() - begin_s
            if n > PROBE_BYTES or waited_s > (FIRST_READING_S if n else listen_s):
                self._raise_no_frame(n)
            self._pump(self._ask_if_due())

    def _raise_no_frame(self, n_bytes: int) -> None:
        if n_bytes == 0:
            raise DeviceSilent(f"{self._url}: nothing comes at {self._health.baud} baud; is it powered, and does the motor turn?")
        rates = " or ".join(map(str, self._driver.bauds))
        raise DeviceGarbled(
            f"{self._url}: {n_bytes} bytes, no valid frame; is the baud rate {rates}, and is this really that device?"
        )

    def _stream(self) -> None:
        """Feed the driver until stopped; restart a stalled stream once, then give up the session."""
        now_s = time.monotonic()
        self._running_since_s = self._last_reading_s = self._last_bytes_s = now_s
        has_run, restarts = False, 0
        judge = StreamJudge(self._driver.counters)
        while not self._stopping.is_set():
            n = self._pump(self._ask_if_due())
            now_s = time.monotonic()
            if n:
                has_run, restarts = True, 0
                self._judge(judge, now_s)
            elif self._is_stalled(now_s, has_run):
                self._restart_stalled(restarts)
                restarts += 1
                self._last_reading_s = self._last_bytes_s = now_s = time.monotonic()

    def _ask_if_due(self) -> float:
        """Poll a device that only answers; how long to wait for what comes."""
        period_s = self._driver.poll_period_s
        if period_s is None:
            return READ_WAIT_S
        assert self._port is not None
        now_s = time.monotonic()
        if now_s >= self._next_poll_s:
            self._port.write(self._driver.poll())
            self._next_poll_s = max(self._next_poll_s + period_s, now_s)
        return min(READ_WAIT_S, max(0.0, self._next_poll_s - now_s))

    def _is_stalled(self, now_s: float, has_run: bool) -> bool:
        """No byte for 0.3 s, or bytes but no reading for three periods."""
        if not has_run:
            return now_s - self._last_reading_s > FIRST_READING_S
        limit_s = max(MIN_STALL_S, STALL_PERIODS * self._driver.period_s)
        return now_s - self._last_bytes_s > MIN_STALL_S or now_s - self._last_reading_s > limit_s

    def _restart_stalled(self, restarts: int) -> None:
        """The stream stood still: start it again, the second time by opening the port anew."""
        message = f"{self._url}: the stream stands still; is the motor blocked, or the cable loose?"
        self._note(stalls=self._health.stalls + 1, state=DeviceState.STARTING, last_error=message)
        if restarts > 0:
            raise DeviceSilent(message)
        self._driver.restart()
        self._play(self._driver.start())

    def _judge(self, judge: StreamJudge, now_s: float) -> None:
        state = judge.state(now_s, self._health.coverage)
        error = judge.error(self._url)
        if state is not self._health.state or (error and error != self._health.last_error):
            self._note(state=state, last_error=error or self._health.last_error)

    def _play(self, script: Script) -> None:
        """Carry out a driver's script; a recording hears nothing."""
        if not self._is_passive:
            assert self._port is not None
            play(script, self._port, self._pump, self._set_baud, self._stopping)

    def _pump(self, wait_s: float) -> int:
        """Move what has come to the driver and its readings to the reader; how many readings there were."""
        assert self._port is not None
        gather_s = self._last_bytes_s + self._driver.gather_s - time.monotonic()
        if gather_s > 0:
            time.sleep(gather_s)
        try:
            data = self._port.read(wait_s)
        except DeviceAbsent:
            self._is_gone = True
            raise
        if not data:
            return 0
        self._last_bytes_s = now_s = time.monotonic()
        if self.tap is not None:
            self.tap(now_s, data)
        self._rates.add(now_s, len(data))
        readings = self._driver.feed(data, now_s)
        for reading in readings:
            self._hand_on(reading, now_s)
        return len(readings)

    def _hand_on(self, reading: Reading, now_s: float) -> None:
        with self._arrived:
            dropped = self._readings.push(reading)
            self._stamps.append(now_s)
            self._last_reading_s = now_s
            self._health = replace(self._health, readings=self._health.readings + 1, dropped=self._health.dropped + dropped)
            if isinstance(reading, LaserScan):
                self._health = replace(
                    self._health, points=len(reading.ranges_m), coverage=getattr(self._driver, "coverage", 1.0)
                )
            self._arrived.notify_all()

    def _set_baud(self, baud: int) -> None:
        assert self._port is not None
        self._port.set_baud(baud)
        self._driver.set_baud(baud)
        self._note(baud=baud)

    def _close(self) -> None:
        port, self._port = self._port, None
        if port is not None:
            port.close()

    def _note(self, **facts: Any) -> None:
        with self._arrived:
            self._health = replace(self._health, **facts)
