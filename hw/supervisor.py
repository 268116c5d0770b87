"""A device that is kept alive: one thread opens its port, wakes it, feeds its driver, and starts again whatever happens.

    DISCONNECTED -> PROBING (which rate, who is it) -> STARTING (motor, first reading) -> RUNNING <-> DEGRADED
         ^                                                                                   |
         +------------- back-off 50 ms, doubled to 2 s, for ever <---- pulled, silent -------+

What happens while the port is open is in `session.py`, what others see of it in `noticeboard.py`.  A device fault never leaves
`read()` as an exception: it is None, and `health()` says why.
"""

from __future__ import annotations

import os
import random
import threading
import time
from collections.abc import Callable

from hw.driver import Driver, Reading
from hw.errors import DeviceError, DeviceSilent
from hw.health import DeviceHealth, DeviceState
from hw.noticeboard import Noticeboard, Tap
from hw.port import Port
from hw.script_player import READ_WAIT_S
from hw.session import KnownRate, Session

FIRST_BACK_OFF_S, LAST_BACK_OFF_S = 0.05, 2.0  # a replugged cable is back within a second; a missing one costs nothing
SILENT_BACK_OFF_S = 0.4  # the port is there, the device says nothing: it may speak again any moment

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
        self._is_passive = is_passive  # see `Session`
        self._board = Noticeboard(url, port_name, driver)
        self._rate = KnownRate()
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None
        self._port: Port | None = None

    def record(self, tap: Tap) -> None:
        """Show `tap` every byte that is fed, with its time."""
        self._board.tap = tap

    def start(self) -> Device:
        """Begin; returns at once, the device comes up in the background."""
        if self._thread is None:
            self._stopping.clear()
            self._board.open()
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
        self._board.close()

    def __enter__(self) -> Device:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.stop()

    def read(self, timeout_s: float) -> Reading | None:
        """The oldest reading not yet fetched, waiting up to `timeout_s`; None when there is none."""
        return self._board.read(timeout_s)

    def health(self) -> DeviceHealth:
        """How the device is doing now."""
        return self._board.health()

    def _run(self) -> None:
        """Open, run, fail, wait, again; until stopped."""
        back_off_s = FIRST_BACK_OFF_S
        while not self._stopping.is_set():
            before = self._board.now.readings
            most_s = LAST_BACK_OFF_S
            try:
                self._session()
            except DeviceError as error:
                most_s = SILENT_BACK_OFF_S if isinstance(error, DeviceSilent) else LAST_BACK_OFF_S
                self._failed(str(error))
            except Exception as error:  # a bug of ours must not silence a robot's eyes
                self._failed(f"internal error {error!r}; please report this")
            if self._board.now.readings > before:
                back_off_s = FIRST_BACK_OFF_S
            self._wait_to_retry(min(back_off_s, most_s) * self._rng.uniform(0.8, 1.2))
            back_off_s = min(2 * back_off_s, LAST_BACK_OFF_S)
            self._board.note(reconnects=self._board.now.reconnects + (not self._stopping.is_set()))
        self._board.note(state=DeviceState.DISCONNECTED)

    def _session(self) -> None:
        """From opening the port to losing the device; returns only when stopped, else raises."""
        self._port = self._open_port(self._rate.baud or self._driver.bauds[0], self._driver.open_dtr)
        try:
            Session(self._url, self._driver, self._port, self._board, self._stopping, self._is_passive).run(self._rate)
        finally:
            port, self._port = self._port, None
            port.close()

    def _failed(self, why: str) -> None:
        scheme, _, _ = self._url.partition(":")
        port = self._board.now.port
        if port and why.startswith(port):
            why = f"{scheme}:{why}"
        elif not why.startswith(self._url):
            why = f"{self._url}: {why}"
        self._board.note(state=DeviceState.DISCONNECTED, last_error=why)

    def _wait_to_retry(self, seconds: float) -> None:
        """Wait; not longer than until a port that was missing is there again."""
        path = self._board.now.port
        was_missing = path.startswith("/") and not os.path.exists(path)
        deadline_s = time.monotonic() + seconds
        while (left_s := deadline_s - time.monotonic()) > 0 and not self._stopping.is_set():
            if was_missing and os.path.exists(path):
                return
            self._stopping.wait(min(left_s, READ_WAIT_S))
