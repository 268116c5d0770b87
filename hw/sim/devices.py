"""Devices that do not exist: what a robot in a simulated world, or in a recording, would send over its serial lines.

A `ByteDevice` is given the time and what the host wrote, and gives the bytes it has sent since it was last asked; it owns no
thread and no clock, so the same device is served through a pty, inside one process, or as fast as a test can read.
"""

from __future__ import annotations

from typing import Protocol

from hw import sick_wire, wheels

PART_OF_TELEGRAM_S = 0.3  # half a telegram is forgotten: a SICK waits 14 ms for each byte, and a busy computer adds to that
LATE_S = 0.5  # a host that did not look for longer missed the rest: a serial line keeps nothing


class ByteDevice(Protocol):
    """One simulated device on a line."""

    @property
    def baud(self) -> int:
        """The rate it speaks at now; 0: any, as on USB."""
        ...

    def receive(self, data: bytes, now_s: float) -> None:
        """The host wrote this."""

    def emit(self, now_s: float) -> bytes:
        """What the device has sent up to now."""


class TickSource(Protocol):
    """What counts: a robot in a world or in a recording."""

    @property
    def info(self) -> wheels.InfoFrame: ...

    def sample(self, time_s: float) -> tuple[int, int, bool]:
        """Left ticks, right ticks, and whether the board restarted since the last sample."""


class Wt1Board:
    """A WT1 wheel board: encoder frames at a fixed rate, an info frame every second."""

    baud = 115200

    def __init__(self, source: TickSource, rate_hz: float = 50.0) -> None:
        self._source, self._period_s = source, 1.0 / rate_hz
        self._next_s: float | None = None
        self._first_s = 0.0
        self._sent = 0

    def receive(self, data: bytes, now_s: float) -> None:
        """The board takes no commands."""

    def emit(self, now_s: float) -> bytes:
        """See `ByteDevice`."""
        if self._next_s is None or now_s - self._next_s > LATE_S:
            self._next_s = now_s
            self._first_s = self._first_s or now_s
        out = bytearray()
        while self._next_s <= now_s:
            out += self._frames(self._next_s)
            self._next_s += self._period_s
        return bytes(out)

    def _frames(self, time_s: float) -> bytes:
        left, right, is_reset = self._source.sample(time_s)
        clock_us = round((time_s - self._first_s) * 1e6) % 2**32
        flags = wheels.FLAG_BOOT if is_reset else 0
        frame = wheels.encode(wheels.EncoderFrame(self._sent % 256, clock_us, _int32(left), _int32(right), flags))
        is_info_due = self._sent % max(1, round(1.0 / self._period_s)) == 0
        self._sent += 1
        return wheels.encode(self._source.info) + frame if is_info_due else frame


SICK_TYPE = b"LMS291;S05;V02.10"
NOT_UNDERSTOOD = b"\x92\x10"


class ScanSource(Protocol):
    """Scans in centimetres for a SICK, each at its moment."""

    def scans_until(self, now_s: float) -> list[list[int]]:
        """Scans that ended since the last call, 181 or 361 values from the right, 0x1FFF where nothing came back."""


class SickScanner:
    """A SICK LMS291 that answers the requests of a host and, once told to, sends each scan of its source."""

    baud = 500000

    def __init__(self, source: ScanSource) -> None:
        self._source = source
        self._inbox = bytearray()
        self._outbox = bytearray()
        self._is_sending = False
        self._heard_s = 0.0

    def receive(self, data: bytes, now_s: float) -> None:
        """Answer every whole telegram in what the host wrote so far; one that is damaged is told so."""
        if now_s - self._heard_s > PART_OF_TELEGRAM_S:
            self._inbox.clear()
        self._heard_s = now_s
        self._inbox += data
        del self._inbox[:-4096]
        while (start := self._inbox.find(sick_wire.STX)) >= 0 and len(self._inbox) >= start + 4:
            size = 6 + (self._inbox[start + 2] | self._inbox[start + 3] << 8)
            telegram = bytes(self._inbox[start : start + size])
            if len(telegram) < size <= 64:
                return
            decoded = sick_wire.decode(telegram) if size <= 64 else None
            del self._inbox[: start + (size if decoded else 1)]
            if decoded is None and 7 <= size <= 64 and telegram[1] == sick_wire.HOST_ADDRESS:
                self._outbox.append(sick_wire.NAK)
            elif decoded:
                self._outbox += bytes((sick_wire.ACK,)) + sick_wire.encode(self._answer(decoded[1]), sick_wire.SCANNER_ADDRESS)

    def _answer(self, payload: bytes) -> bytes:
        if payload == sick_wire.CONTINUOUS:
            self._is_sending = True
        elif payload == sick_wire.POLLED:
            self._is_sending = False
        if payload[0] == sick_wire.MODE:
            rates = {code: rate for rate, code in sick_wire.RATE_CODES.items()}
            self.baud = rates.get(payload[-1], self.baud) if len(payload) == 2 else self.baud  # from the answer on
            return b"\xa0\x00\x10"
        if payload[0] == sick_wire.VARIANT:
            return b"\xbb\x01" + payload[1:] + b"\x10"
        if payload in (sick_wire.STATUS, sick_wire.ERRORS):
            return bytes((payload[0] | 0x80,)) + b"\x10"
        return b"\xba" + SICK_TYPE + b"\x10" if payload == sick_wire.TYPE else NOT_UNDERSTOOD

    def emit(self, now_s: float) -> bytes:
        """See `ByteDevice`."""
        out = bytes(self._outbox)
        self._outbox.clear()
        scans = self._source.scans_until(now_s) if self._is_sending else []
        return out + b"".join(sick_wire.scan_telegram(values) for values in scans)


def _int32(value: int) -> int:
    return (value + 2**31) % 2**32 - 2**31
