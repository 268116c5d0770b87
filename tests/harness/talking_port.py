"""A device in this process that answers commands and streams at its pace: a `Port` for handshake tests, without a pty."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from hw.errors import DeviceAbsent

Answer = Callable[["TalkingPort", bytes], None]  # (port, what the host wrote): may call say, stream and silence


class TalkingPort:
    """`answer` plays the device.  One object outlives many openings, as a device does; `gone` pulls the cable."""

    def __init__(self, answer: Answer | None = None, works_at: tuple[int, ...] = ()) -> None:
        self._answer = answer
        self._works_at = works_at  # baud; at others nothing is understood and garbage is heard
        self._lock = threading.Lock()
        self._queue = bytearray()
        self._stream, self._rate, self._at, self._since_s = b"", 0.0, 0, 0.0
        self.baud = 0
        self.opened = 0
        self.gone = False
        self.heard: list[bytes] = []
        self.lines: list[tuple[bool | None, bool | None]] = []
        self.bauds: list[int] = []

    def open(self, baud: int, _dtr: bool | None = None) -> TalkingPort:
        """What a `Device` calls."""
        if self.gone:
            raise DeviceAbsent("no such port")
        self.opened += 1
        self.set_baud(baud)
        return self

    def say(self, data: bytes) -> None:
        """The device sends this once."""
        with self._lock:
            self._queue += data

    def stream(self, data: bytes, bytes_per_s: float) -> None:
        """The device sends this again and again."""
        with self._lock:
            self._stream, self._rate, self._at, self._since_s = data, bytes_per_s, 0, time.monotonic()

    def silence(self) -> None:
        """The device stops sending."""
        self.stream(b"", 0.0)

    def read(self, timeout_s: float) -> bytes:
        deadline_s = time.monotonic() + timeout_s
        while True:
            data = self._due()
            if data:
                return data
            if time.monotonic() >= deadline_s:
                return b""
            time.sleep(0.002)

    def _due(self) -> bytes:
        if self.gone:
            raise DeviceAbsent("the port went away while reading")
        with self._lock:
            data = bytes(self._queue)
            self._queue.clear()
            if self._stream:
                n = int((time.monotonic() - self._since_s) * self._rate) - self._at
                first = self._at % len(self._stream)
                streamed = (self._stream[first:] + self._stream)[:n] if n > 0 else b""
                self._at += len(streamed)
                data += streamed
        return data if self._is_understood() else bytes(b ^ 0x5B for b in data)

    def _is_understood(self) -> bool:
        return not self._works_at or self.baud in self._works_at

    def write(self, data: bytes) -> None:
        if self.gone:
            raise DeviceAbsent("the port went away while writing")
        self.heard.append(data)
        if self._answer is not None and self._is_understood():
            self._answer(self, data)

    def set_baud(self, baud: int) -> None:
        self.baud = baud
        self.bauds.append(baud)

    def set_lines(self, dtr: bool | None, rts: bool | None) -> None:
        self.lines.append((dtr, rts))

    def flush_input(self) -> None:
        with self._lock:
            self._queue.clear()

    def wake(self) -> None:
        pass

    def close(self) -> None:
        pass
