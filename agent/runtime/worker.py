"""A worker: one thread with one job, which says that it makes progress.

`step` does a little and returns within a second or so; a worker that does not come back within its deadline is stuck, and
the watchdog stops being fed.  An exception in a step is counted, logged once with its traceback, and the worker goes on.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

log = logging.getLogger(__name__)

PAUSE_AFTER_ERROR_S = 0.2


@dataclass(frozen=True, slots=True)
class WorkerReport:
    """How a worker is doing, for status and watchdog."""

    name: str
    idle_s: float  # since the last finished step
    deadline_s: float
    steps: int
    errors: int
    last_error: str
    cpu_s: float = 0.0  # of its thread, so far
    is_failing: bool = False  # the newest step ended with an exception

    @property
    def is_stuck(self) -> bool:
        return self.idle_s > self.deadline_s


class Worker:
    """Runs `step` again and again on a thread of its own until stopped."""

    def __init__(self, name: str, step: Callable[[], None], deadline_s: float, reads: str, writes: str) -> None:
        self.name, self.deadline_s, self.reads, self.writes = name, deadline_s, reads, writes
        self.step = step
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._progress_s = time.monotonic()
        self.steps = 0
        self.errors = 0
        self.last_error = ""
        self._cpu_s = 0.0
        self._is_failing = False

    def start(self) -> None:
        self._progress_s = time.monotonic()
        self._thread.start()

    def ask_to_stop(self) -> None:
        self._stop.set()

    def join(self, timeout_s: float) -> bool:
        """True when the thread has ended."""
        if self._thread.is_alive():
            self._thread.join(max(0.0, timeout_s))
        return not self._thread.is_alive()

    def report(self) -> WorkerReport:
        idle_s = time.monotonic() - self._progress_s
        return WorkerReport(
            self.name, idle_s, self.deadline_s, self.steps, self.errors, self.last_error, self._cpu_s, self._is_failing
        )

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                self.step()
                self._is_failing = False
            except Exception as error:
                self._note(error)
            self.steps += 1
            self._cpu_s = time.thread_time()
            self._progress_s = time.monotonic()

    def _note(self, error: Exception) -> None:
        """First time with traceback, then the 10th, 100th, ...: a fault that repeats does not fill the disk."""
        self.errors += 1
        self._is_failing = True
        self.last_error = f"{type(error).__name__}: {error}"
        if str(self.errors).strip("0") == "1":
            log.error("worker=%s failed, goes on; errors=%d", self.name, self.errors, exc_info=error)
        self._stop.wait(PAUSE_AFTER_ERROR_S)
