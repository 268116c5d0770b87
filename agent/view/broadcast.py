"""One status for everybody who looks: made once, encoded once, and of what is known already nothing is sent again.

    data: {"full": {...}}     to who comes, and to who fell behind
    data: {"part": {...}}     the keys that changed since, to all the others; five times a second at most

One thread writes to all of them and waits for none: a viewer that does not read gets the next whole status when it reads again.
While nobody looks, nothing is made.
"""

from __future__ import annotations

import contextlib
import json
import logging
import socket
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

log = logging.getLogger(__name__)

PERIOD_S = 0.2
KEEP_ALIVE_S = 10.0
GIVE_UP_AFTER_S = 60.0  # a phone that sleeps for longer connects anew by itself
STILL_HERE = b": still here\n\n"


@dataclass(slots=True, eq=False)
class Viewer:
    """One connection, ours until it ends."""

    socket: socket.socket
    unsent: bytes = b""
    is_behind: bool = True  # the next thing it gets is the whole status
    took_s: float = 0.0  # when it last took something


class Broadcast:
    """Feeds every viewer until closed."""

    def __init__(self, status: Callable[[], Mapping[str, Any]], on_leave: Callable[[socket.socket], None]) -> None:
        self._status, self._on_leave = status, on_leave
        self._joining: list[Viewer] = []
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._closed = threading.Event()
        self._viewers: list[Viewer] = []
        self._told: dict[str, bytes] = {}  # key -> its value as JSON
        self._spoke_s = 0.0
        self._thread = threading.Thread(target=self._run, name="view-events", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        self._closed.set()
        self._wake.set()
        self._thread.join(2.0)

    def join(self, connection: socket.socket) -> None:
        """Takes a connection over whose head has been sent."""
        connection.setblocking(False)
        with self._lock:
            self._joining.append(Viewer(connection, took_s=time.monotonic()))
        self._wake.set()

    def _run(self) -> None:
        while not self._closed.is_set():
            with self._lock:
                self._viewers += self._joining
                self._joining.clear()
                if not self._viewers:
                    self._wake.clear()
            if self._viewers:
                try:
                    self._tell()
                except Exception:  # the status comes from another room
                    log.exception("view: no status")
                self._closed.wait(PERIOD_S)
            else:
                self._wake.wait()
        for viewer in [*self._viewers, *self._joining]:
            self._leave(viewer)

    def _tell(self) -> None:
        status = {key: json.dumps(value).encode() for key, value in self._status().items()}
        part = _event(b"part", {key: value for key, value in status.items() if self._told.get(key) != value})
        self._told, now_s = status, time.monotonic()
        if not part and now_s - self._spoke_s > KEEP_ALIVE_S:
            part = STILL_HERE
        self._spoke_s = now_s if part else self._spoke_s
        full = b""
        for viewer in list(self._viewers):
            if viewer.is_behind and not viewer.unsent:
                full = full or _event(b"full", status)
                self._send(viewer, full, now_s)
                viewer.is_behind = False
            elif viewer.unsent:
                viewer.is_behind = viewer.is_behind or bool(part)
                self._send(viewer, b"", now_s)
            elif part:
                self._send(viewer, part, now_s)

    def _send(self, viewer: Viewer, data: bytes, now_s: float) -> None:
        """As much as it takes now; the rest waits."""
        viewer.unsent += data
        try:
            sent = viewer.socket.send(viewer.unsent)
        except BlockingIOError:
            sent = 0
        except OSError:
            self._leave(viewer)
            return
        viewer.unsent = viewer.unsent[sent:]
        viewer.took_s = now_s if sent or not viewer.unsent else viewer.took_s
        if now_s - viewer.took_s > GIVE_UP_AFTER_S:
            self._leave(viewer)

    def _leave(self, viewer: Viewer) -> None:
        if viewer in self._viewers:
            self._viewers.remove(viewer)
        with contextlib.suppress(OSError):
            viewer.socket.shutdown(socket.SHUT_RDWR)
        self._on_leave(viewer.socket)


def _event(kind: bytes, values: Mapping[str, bytes]) -> bytes:
    """A server-sent event of JSON values that are encoded already; nothing when there are none."""
    if not values:
        return b""
    pairs = b",".join(json.dumps(key).encode() + b":" + value for key, value in values.items())
    return b'data: {"' + kind + b'":{' + pairs + b"}}\n\n"
