"""Simulated devices on pseudo-terminals, each behind a stable link: real serial ports for other programs."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import pty
import select
import struct
import threading
import time
import tty
from collections.abc import Iterable
from pathlib import Path

from hw.sim.devices import ByteDevice
from hw.sim.faults import FaultyDevice, garbled

TICK_S = 0.01  # how often bytes move; a 230400 baud line carries 230 bytes in that time
TCGETS2 = 0x802C542A
TERMIOS2 = struct.Struct("=4IB19sII")  # flags, line discipline, control characters, input and output rate
PTYS = "/dev/pts/"  # a link to one of them is left over from a simulator that was killed
USB_KEEPS_BYTES = 32768  # a unit on USB waits for a host that reads slowly, and leaves whole messages out beyond this


class PtyLine:
    """One device on one pseudo-terminal behind a link whose name stays the same.

    The line has a rate: a client that opens it at another one hears garbage and is not understood, unless the device's
    `baud` is 0, as on USB.
    """

    def __init__(self, device: ByteDevice, link: Path) -> None:
        self.device, self.link = device, link
        self._master, self._name = -1, ""
        self._is_open = False  # by a client, at the last look
        self._kept = b""  # of a unit on USB, until its host reads
        self._poll = select.poll()
        self.plug()

    @property
    def heard(self) -> list[int]:
        """What to wait on for a client's words; nothing while there is no client."""
        return [self._master] if self._is_open and self._master >= 0 else []

    def plug(self) -> None:
        """The port appears, under whatever name the system gives it."""
        if os.path.lexists(self.link) and not _target(self.link).startswith(PTYS):
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(self.link))
        self._master, slave = pty.openpty()
        self._name = os.ttyname(slave)
        tty.setraw(slave)  # a fresh pty echoes: device bytes would come back as commands
        os.set_blocking(self._master, False)
        aside = self.link.with_name(f".{self.link.name}.{os.getpid()}")
        aside.symlink_to(self._name)
        aside.replace(self.link)
        os.close(slave)
        self._poll.register(self._master, select.POLLIN)

    def unplug(self) -> None:
        """The port is gone; whoever has it open reads an error."""
        if self._master >= 0:
            if _target(self.link) == self._name:  # else another simulator has taken the name over
                self.link.unlink(missing_ok=True)
            self._poll.unregister(self._master)
            os.close(self._master)
            self._master, self._kept = -1, b""

    def pump(self, now_s: float) -> None:
        """Move what is due in both directions; while nobody has the port open, the device talks to the air."""
        faulty = self.device if isinstance(self.device, FaultyDevice) else None
        if faulty and faulty.is_absent(now_s):
            self.unplug()
            self.device.emit(now_s)
            return
        if self._master < 0:
            self.plug()
        events = dict(self._poll.poll(0)).get(self._master, 0)
        is_open = self._is_open = not events & select.POLLHUP
        is_right_rate = not is_open or self.device.baud in (0, client_baud(self._master))
        if events & select.POLLIN:
            with contextlib.suppress(OSError):
                data = os.read(self._master, 4096)
                self.device.receive(data if is_right_rate else garbled(data), now_s)
        out = self.device.emit(now_s)
        if is_open or (faulty and faulty.keeps_talking):
            self._send(out if is_right_rate else garbled(out))
        else:
            self._kept = b""

    def _send(self, out: bytes) -> None:
        """A full line loses bytes, as a serial line does; USB does not."""
        out = self._kept + (out if len(self._kept) < USB_KEEPS_BYTES else b"")
        sent = 0
        if out:
            with contextlib.suppress(OSError):
                sent = os.write(self._master, out)
        self._kept = out[sent:] if self.device.baud == 0 else b""

    def close(self) -> None:
        """Unplug for good."""
        self.unplug()


def _target(link: Path) -> str:
    """Where a symbolic link points; of anything else nothing."""
    try:
        return os.readlink(link)
    except OSError:
        return ""


def client_baud(master: int) -> int:
    """The rate at which the other side has opened a pty; termios2 also tells the odd ones."""
    answer = fcntl.ioctl(master, TCGETS2, bytes(TERMIOS2.size))
    return int(TERMIOS2.unpack(answer)[-1])


class PtyServer:
    """A thread that keeps lines moving.  Use it in a `with`."""

    def __init__(self, lines: Iterable[tuple[ByteDevice, Path]], name: str = "simulated devices", tick_s: float = TICK_S) -> None:
        self._tick_s = tick_s
        self._lines = [PtyLine(device, link) for device, link in lines]
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def __enter__(self) -> PtyServer:
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._stop.set()
        self._thread.join()
        for line in self._lines:
            line.close()

    def _run(self) -> None:
        while not self._stop.is_set():
            self._wait()
            for line in self._lines:
                line.pump(time.monotonic())

    def _wait(self) -> None:
        """For a tick, or until a client says something."""
        heard = [fd for line in self._lines for fd in line.heard]
        if heard:
            select.select(heard, [], [], self._tick_s)
        else:
            self._stop.wait(self._tick_s)
