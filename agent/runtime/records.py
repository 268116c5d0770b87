"""Every merge attempt is a record, accepted or not: kept for the page, and one JSON line each on disk.

The file is appended to and flushed per line, so a crash loses at most the line being written; it is renamed once when it
has grown large, so that it never fills a disk.  Lines that a failing disk refused wait for the next one that it takes.
"""

from __future__ import annotations

import json
import logging
import math
import threading
import time
from collections import deque
from pathlib import Path
from typing import Any

from agent.fleet.effects import Note
from agent.runtime.merge_times import MergeTimes

log = logging.getLogger(__name__)

KEPT = 200
MAX_FILE_BYTES = 8 * 1024 * 1024


class Records:
    """What happened between us and the others, newest last."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._lock = threading.Lock()
        self._kept: deque[dict[str, Any]] = deque(maxlen=KEPT)
        self._unwritten: deque[str] = deque(maxlen=KEPT)
        self._since_s = time.monotonic()
        self.counts: dict[str, int] = {}
        self.times = MergeTimes()
        self.last_error = ""  # why the newest lines are not on disk

    def add(self, note: Note) -> None:
        uptime_s = time.monotonic() - self._since_s
        record = {
            "event": note.event,
            "time": time.strftime("%Y-%m-%dT%H:%M:%S%z"),  # a label for people, never compared
            "uptime_s": round(uptime_s, 3),
            **{name: plain(value) for name, value in note.facts.items()},
        }
        with self._lock:
            self._kept.append(record)
            self.times.add(note.event, note.facts, uptime_s)
            self.counts[note.event] = self.counts.get(note.event, 0) + 1
            self._write(record)

    def of(self, event: str, count: int = 20) -> list[dict[str, Any]]:
        with self._lock:
            return [record for record in self._kept if record["event"] == event][-count:]

    def edge_age_s(self, a: str, b: str) -> float | None:
        """Since the edge between two robots last began."""
        with self._lock:
            return self.times.edge_age_s(a, b, time.monotonic() - self._since_s)

    def merge_times(self) -> dict[str, Any] | None:
        """See `MergeTimes.took`."""
        with self._lock:
            return self.times.took()

    def newest(self, count: int) -> list[dict[str, Any]]:
        with self._lock:
            return list(self._kept)[-count:]

    def _write(self, record: dict[str, Any]) -> None:
        if self._path is None:
            return
        self._unwritten.append(json.dumps(record) + "\n")
        try:
            self._append(self._path, "".join(self._unwritten))
        except OSError as error:
            if not self.last_error:
                log.warning("records: cannot write %s: %s; kept in memory until it can", self._path, error)
            self.last_error = str(error)
            return
        if self.last_error:
            log.info("records: writing works again in %s", self._path)
        self.last_error = ""
        self._unwritten.clear()

    def _append(self, path: Path, lines: str) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists() and path.stat().st_size > MAX_FILE_BYTES:
            path.replace(path.with_suffix(".old.jsonl"))
        with path.open("a") as file:
            file.write("\n" * bool(self.last_error) + lines)  # the try before may have left half a line


def plain(value: Any) -> Any:
    """A fact as a JSON value."""
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return round(value, 6) if math.isfinite(value) else None
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return str(value)
