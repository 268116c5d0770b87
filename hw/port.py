"""The one door to serial lines: bytes in, bytes out, and every way a port can fail told as one of three errors.

Written against what pyserial really does on Linux (SERIAL.md section 9): modem lines of a pty are ENOTTY and ignored; a
cable that is pulled shows as SerialException, OSError(EIO) or termios.error; `exclusive` is a flock that keeps a second
careful program away.  Nothing here understands a byte.
"""

from __future__ import annotations

import contextlib
import errno
import os
import select
import termios
from typing import Protocol

import serial
from serial.tools import list_ports

from hw.errors import DeviceAbsent, DeviceConfigError

GONE = (serial.SerialException, OSError, termios.error, TypeError)  # TypeError: pyserial, closed under a reader
MAX_READ_BYTES = 16384


class Port(Protocol):
    """A byte line; `SerialPort` is the real one, simulators and recordings bring their own."""

    def read(self, timeout_s: float) -> bytes:
        """What has come, waiting at most this long for the first byte; b"" when nothing did.  DeviceAbsent when it is gone."""

    def write(self, data: bytes) -> None: ...

    def set_baud(self, baud: int) -> None: ...

    def set_lines(self, dtr: bool | None, rts: bool | None) -> None: ...

    def flush_input(self) -> None: ...

    def wake(self) -> None:
        """Make a read in another thread return now."""

    def close(self) -> None: ...


class SerialPort:
    """A tty, a pty, or any address pyserial knows (`socket://`, `rfc2217://`), opened for us alone."""

    def __init__(self, path: str, baud: int, open_dtr: bool | None = None) -> None:
        self.path = path
        self.has_modem_lines = True
        is_file = "://" not in path
        try:
            self._serial = serial.serial_for_url(path, baudrate=baud, timeout=0.05, do_not_open=True)
            if is_file:  # rfc2217:// knows no such thing
                self._serial.write_timeout = 1.0
            if open_dtr is not None:
                self._serial.dtr = open_dtr
            if is_file and hasattr(self._serial, "exclusive"):
                self._serial.exclusive = True
            self._serial.open()
        except ValueError as error:
            raise DeviceConfigError(f"{path}: {error}") from error
        except GONE as error:
            raise DeviceAbsent(why_not_open(path, error)) from error
        self._fd: int | None = self._serial.fileno() if is_file else None
        with contextlib.suppress(*GONE, ValueError, NotImplementedError, AttributeError):
            self._serial.set_low_latency_mode(True)  # FTDI waits 16 ms otherwise; a pty refuses

    def read(self, timeout_s: float) -> bytes:
        """See `Port.read`."""
        try:
            return self._read_fd(timeout_s) if self._fd is not None else self._read_any(timeout_s)
        except GONE as error:
            raise DeviceAbsent(f"{self.path}: the port went away while reading ({error}); is the cable plugged in?") from error

    def _read_fd(self, timeout_s: float) -> bytes:
        """A third of the cost of pyserial's read, whose timeout cannot be changed without setting up the whole port anew."""
        assert self._fd is not None
        ready, _, _ = select.select([self._fd], [], [], timeout_s)
        if not ready:
            return b""
        try:
            data = os.read(self._fd, MAX_READ_BYTES)
        except BlockingIOError:
            return b""
        if not data:
            raise OSError(errno.EIO, "ready to read, but nothing there; or two programs share the port")
        return data

    def _read_any(self, timeout_s: float) -> bytes:
        """Ports that are no file (`socket://`, `rfc2217://`)."""
        if self._serial.timeout != timeout_s:
            self._serial.timeout = timeout_s
        data: bytes = self._serial.read(1)
        waiting = min(self._serial.in_waiting, MAX_READ_BYTES) if data else 0
        return data + self._serial.read(waiting) if waiting else data

    def write(self, data: bytes) -> None:
        """See `Port.write`; a line that takes nothing for a second is as good as gone."""
        try:
            self._serial.write(data)
        except GONE as error:
            raise DeviceAbsent(f"{self.path}: the port went away while writing ({error}); is the cable plugged in?") from error

    def set_baud(self, baud: int) -> None:
        """See `Port.set_baud`."""
        try:
            self._serial.baudrate = baud
        except ValueError as error:
            raise DeviceConfigError(f"{self.path}: this adapter cannot do {baud} baud: {error}") from error
        except GONE as error:
            raise DeviceAbsent(f"{self.path}: the port went away while changing to {baud} baud ({error})") from error

    def set_lines(self, dtr: bool | None, rts: bool | None) -> None:
        """Set DTR and RTS where there are such lines; a pty has none, which is remembered and no fault."""
        for name, level in (("dtr", dtr), ("rts", rts)):
            if level is not None and self.has_modem_lines:
                try:
                    setattr(self._serial, name, level)
                except GONE as error:
                    if getattr(error, "errno", None) not in (errno.ENOTTY, errno.EINVAL):
                        raise DeviceAbsent(f"{self.path}: the port went away while setting {name.upper()} ({error})") from error
                    self.has_modem_lines = False

    def flush_input(self) -> None:
        """Drop what the kernel holds."""
        try:
            self._serial.reset_input_buffer()
        except GONE as error:
            raise DeviceAbsent(f"{self.path}: the port went away ({error})") from error

    def wake(self) -> None:
        """See `Port.wake`."""
        with contextlib.suppress(*GONE, AttributeError):
            self._serial.cancel_read()

    def close(self) -> None:
        """Close, whatever state the port is in."""
        with contextlib.suppress(*GONE):
            self._serial.close()


def why_not_open(path: str, error: BaseException) -> str:
    """One sentence: what is wrong with this port, and what to try."""
    number = getattr(error, "errno", None)
    if number == errno.EACCES or "Permission denied" in str(error):
        return f"{path}: no permission; add yourself to the group that owns it: sudo usermod -aG dialout $USER, then log in again"
    if number in (errno.EBUSY, errno.EAGAIN, errno.EWOULDBLOCK) or "exclusively lock" in str(error):
        return f"{path}: another program has it open ({user_of(path) or 'unknown'}); stop that program first"
    if number == errno.ENOENT or not os.path.exists(path):
        return f"{path}: no such port; is it plugged in? `mapquilt devices` lists the ports there are"
    if number == errno.EISDIR or "(25," in str(error):  # pyserial's ENOTTY
        return f"{path}: no serial port; `mapquilt devices` lists the ports there are"
    return f"{path}: cannot be opened: {error}"


def user_of(path: str) -> str:
    """Name and id of another process that holds this port open, as far as /proc lets us see; "" when none is seen."""
    real = os.path.realpath(path)
    for pid in filter(str.isdigit, os.listdir("/proc")):
        if int(pid) == os.getpid():
            continue
        with contextlib.suppress(OSError):
            if any(os.path.realpath(f"/proc/{pid}/fd/{fd}") == real for fd in os.listdir(f"/proc/{pid}/fd")):
                with open(f"/proc/{pid}/comm", encoding="utf-8") as file:
                    return f"{file.read().strip()}, process {pid}"
    return ""


def port_list() -> list[tuple[str, str]]:
    """(device, description) of the serial ports of this computer; built-in ones without hardware are left out."""
    return [(port.device, port.description or "") for port in sorted(list_ports.comports()) if port.hwid != "n/a"]
