"""The mapper's thread: readings in, the newest estimate out.

Nothing but readings and a person's command reaches this thread: a slow network or a long match leaves mapping alone.
"""

from __future__ import annotations

import logging
import math
import queue
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace

from agent.mapping.estimate import MapEstimate, MapperStatus, ScanOutcome
from agent.mapping.mapper import Mapper
from agent.runtime.latest import Latest
from agent.runtime.pace import REAL, Pace
from agent.runtime.sensing import Readings
from protocol.geometry import SE2

log = logging.getLogger(__name__)

WAIT_S = 0.25
WAIT_FOR_ODOMETRY_S = 0.12  # two samples of a 20 Hz encoder board
MAX_LOOP_PLACES = 100
ESTIMATE_PERIOD_S = 1.0  # an estimate copies the whole grid; peers and the page need no more


class MapWorker:
    """Owns the mapper.  Others ask through `call`, and are served between two scans."""

    def __init__(
        self, mapper: Mapper, readings: Readings, estimate_period_s: float = ESTIMATE_PERIOD_S, pace: Pace = REAL
    ) -> None:
        self.mapper = mapper
        self.estimates: Latest[MapEstimate] = Latest()  # for the snapshot worker
        self.newest: MapEstimate | None = None  # for whoever looks; replaced as a whole
        self.loop_places: deque[SE2] = deque(maxlen=MAX_LOOP_PLACES)  # where the robot was when a loop was closed, to look at
        self.is_paused = False
        self.scans = 0
        self.held = 0  # scans in a row that were not believed ...
        self.held_reason = ""  # ... and why the newest was not
        self.scan_cpu_s = 0.0  # CPU of this thread spent on scans
        self._readings, self._pace = readings, pace
        self._period_s = estimate_period_s
        self._next_estimate_s = 0.0
        # A map saved before this computer was started again bears later stamps than its clock now gives.
        saved_s = mapper.estimate().stamp_s
        self._shift_s = saved_s + 1.0 - pace.clock() if saved_s > pace.clock() else 0.0
        self._calls: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()

    def call(self, action: Callable[[], None]) -> None:
        """Run `action` on this thread, between two scans."""
        self._calls.put(action)

    def step(self) -> None:
        while not self._calls.empty():
            self._calls.get()()
        odometry, scan = self._readings.take(self._pace.wait_s(WAIT_S), self._pace.wait_s(WAIT_FOR_ODOMETRY_S))
        for sample in odometry:
            self.mapper.add_odometry(replace(sample, stamp_s=sample.stamp_s + self._shift_s) if self._shift_s else sample)
        if scan is None or self.is_paused:
            return
        started = time.thread_time()
        outcome = self.mapper.add_scan(replace(scan, stamp_s=scan.stamp_s + self._shift_s) if self._shift_s else scan)
        if outcome.loop is not None:
            turned_deg = math.degrees(outcome.loop.turned_rad)
            log.info("loop closed moved_m=%.2f turned_deg=%.1f", outcome.loop.moved_m, turned_deg)
        self.scan_cpu_s += time.thread_time() - started
        self.scans += 1
        self._note_held(outcome)
        now = self._pace.clock()
        if now >= self._next_estimate_s:
            self._next_estimate_s = now + self._period_s
            self.publish()

    def _note_held(self, outcome: ScanOutcome) -> None:
        is_held = outcome.status in (MapperStatus.LOST, MapperStatus.STUCK, MapperStatus.BLIND)
        self.held, self.held_reason = (self.held + 1, outcome.reason) if is_held else (0, "")

    def publish(self) -> None:
        before, self.newest = self.newest, self.mapper.estimate()
        if before is not None and self.newest.epoch != before.epoch:
            self.loop_places.clear()
        elif before is not None and self.newest.loops_closed > before.loops_closed:
            self.loop_places.append(self.newest.T_map_robot)
        self.estimates.put(self.newest)
