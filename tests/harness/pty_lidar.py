"""An LD06 on a real pty that falls silent and whose cable is pulled, for tests and timings of the supervisor."""

from __future__ import annotations

import contextlib
import os
import pty
import threading
import time
import tty
from collections.abc import Callable
from pathlib import Path

from tests.harness.lidar_streams import STREAMS, Stream

LD06: Stream = STREAMS["ld06"](seconds=3.0)


class PtyLidar:
    """An LD06 on a pty behind a link; it can fall silent, and its cable can be pulled and plugged in elsewhere."""

    def __init__(self, link: Path) -> None:
        self.link = link
        self.is_silent = False
        self.mangle: Callable[[bytes], bytes] = bytes
        self._master: int | None = None
        self._stop = threading.Event()
        self._lock = threading.Lock()
        self.plug_in()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def plug_in(self) -> None:
        master, slave = pty.openpty()
        tty.setraw(slave)
        os.set_blocking(master, False)
        self.link.unlink(missing_ok=True)
        self.link.symlink_to(os.ttyname(slave))
        os.close(slave)
        with self._lock:
            self._master = master

    def pull(self) -> None:
        with self._lock:
            master, self._master = self._master, None
        self.link.unlink()
        assert master is not None
        os.close(master)

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        if self._master is not None:
            os.close(self._master)

    def _run(self) -> None:
        begin_s, at = time.monotonic(), 0
        while not self._stop.wait(0.004):
            n = int((time.monotonic() - begin_s) * LD06.bytes_per_s) - at
            first = at % len(LD06.data)
            data = (LD06.data[first:] + LD06.data)[:n]
            at += n
            with self._lock, contextlib.suppress(OSError):
                if self._master is not None and not self.is_silent:
                    os.write(self._master, self.mangle(data))
