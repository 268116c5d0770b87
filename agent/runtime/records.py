"""Every merge attempt is a record, accepted or not: kept for the page, and one JSON line each on disk.

The file is appended to and flushed per line, so a crash loses at most the line being written; it is renamed once when it
has grown large, so that it never fills a disk.
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

log = logging.getLogger(__name__)

KEPT = 200
MAX_FILE_BYTES = 8 * 1024 * 1024


class Records:
    """What happened between us and the others, newest last."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._lock = threading.Lock()
        self._kept: deque[dict[str, Any]] = deque(maxlen=KEPT)
        self._since_s = time.monotonic()
        self.counts: dict[str, int] = {}

    def add(self, note: Note) -> None:
        record = {
            "event": note.event,
            "time": time.strftime("%Y-%m-%dT%H:%M:%S%z"),  # a label for people, never compared
            "uptime_s": round(time.monotonic() - self._since_s, 3),
            **{name: plain(value) for name, value in note.facts.items()},
        }
        with self._lock:
            self._kept.append(record)
            self.counts[note.event] = self.counts.get(note.event, 0) + 1
            self._write(record)

    def of(self, event: str, count: int = 20) -> list[dict[str, Any]]:
        with self._lock:
            return [record for record in self._kept if record["event"] == event][-count:]

    def newest(self, count: int) -> list[dict[str, Any]]:
        with self._lock:
            return list(self._kept)[-count:]

    def _write(self, record: dict[str, Any]) -> None:
        if self._path is None:
            return
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            if self._path.exists() and self._path.stat().st_size > MAX_FILE_BYTES:
                self._path.replace(self._path.with_suffix(".old.jsonl"))
            with self._path.open("a") as file:
                file.write(json.dumps(record) + "\n")
        except OSError as error:
            log.warning("records: cannot write %s: %s; goes on without", self._path, error)
            self._path = None


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
