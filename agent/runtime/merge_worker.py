"""Matching and fusing on a thread of their own: mapping never waits for them, and the network neither.

Short work overtakes long work (fuse, verify, coarse, search).  Snapshots are kept under their map's digest, so that
the features and fields of a map are made once, however many peers it is compared with.
"""

from __future__ import annotations

import itertools
import queue
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

from agent.features.snapshot import MapSnapshot
from agent.fleet.effects import Fuse, Match, MatchKind
from agent.merging.fusion import FusedMap, fuse
from agent.merging.matching import match_maps, verify_match
from agent.merging.result import MatchOptions, MergeResult
from agent.runtime.pace import REAL, Pace
from protocol.grid import OccupancyGrid

MAX_JOBS = 64
MAX_SNAPSHOTS = 3  # a few MB each: ours, and the peers whose turn it is; six saved no CPU, since every map grows meanwhile
WAIT_S = 0.25

RANK = {MatchKind.VERIFY: 1, MatchKind.COARSE: 2, MatchKind.SEARCH: 3}


@dataclass(frozen=True, slots=True, eq=False)
class Matched:
    """A finished comparison; `result` is None when it failed or was dropped."""

    job: Match
    result: MergeResult | None


@dataclass(frozen=True, slots=True, eq=False)
class Laid:
    """A finished global map; `result` is None when it failed or was dropped."""

    job: Fuse
    result: FusedMap | None


Done = Matched | Laid
OnDone = Callable[[Done], None]


class MergeWorker:
    """Takes `Match` and `Fuse` jobs; each comes back through its `on_done`, finished or dropped."""

    def __init__(self, options: MatchOptions, pace: Pace = REAL) -> None:
        self._options, self._pace = options, pace
        self._jobs: queue.PriorityQueue[tuple[int, int, Match | Fuse, OnDone]] = queue.PriorityQueue(maxsize=MAX_JOBS)
        self._order = itertools.count()
        self._snapshots: OrderedDict[bytes, tuple[str, MapSnapshot]] = OrderedDict()
        self.cpu_s = 0.0
        self.dropped = 0

    def submit(self, job: Match | Fuse, on_done: OnDone) -> None:
        """Never waits: with too much to do already, the job is dropped and comes back without a result."""
        rank = RANK[job.kind] if isinstance(job, Match) else 0
        try:
            self._jobs.put_nowait((rank, next(self._order), job, on_done))
        except queue.Full:
            self.dropped += 1
            on_done(Laid(job, None) if isinstance(job, Fuse) else Matched(job, None))

    def waiting(self) -> int:
        return self._jobs.qsize()

    def step(self) -> None:
        try:
            _, _, job, on_done = self._jobs.get(timeout=self._pace.wait_s(WAIT_S))
        except queue.Empty:
            return
        started = time.thread_time()
        done: Done = Laid(job, None) if isinstance(job, Fuse) else Matched(job, None)
        try:
            done = Laid(job, fuse(job.maps, job.resolution_m)) if isinstance(job, Fuse) else Matched(job, self._match(job))
        finally:
            self.cpu_s += time.thread_time() - started
            on_done(done)

    def _match(self, job: Match) -> MergeResult:
        ours = self._snapshot("", job.ours_digest, job.ours)
        theirs = self._snapshot(job.peer, job.theirs_digest, job.theirs)
        if job.kind is MatchKind.VERIFY and job.T_ours_theirs is not None:
            return verify_match(ours, theirs, job.T_ours_theirs, self._options)
        return match_maps(ours, theirs, self._options)

    def _snapshot(self, peer: str, digest: bytes, grid: OccupancyGrid) -> MapSnapshot:
        """Of a peer's map, or of ours ("")."""
        key = digest + str(grid.resolution_m).encode()  # coarse and fine maps of one version share the digest
        if key not in self._snapshots:
            self._snapshots[key] = peer, self._made(peer, grid)
            while len(self._snapshots) > MAX_SNAPSHOTS:
                self._snapshots.popitem(last=False)
        self._snapshots.move_to_end(key)
        return self._snapshots[key][1]

    def _made(self, peer: str, grid: OccupancyGrid) -> MapSnapshot:
        """From what an earlier state of the same map left, where one is kept."""
        for whose, earlier in reversed(self._snapshots.values()):
            if whose == peer and earlier.grid.resolution_m == grid.resolution_m:
                return earlier.updated(grid)
        return MapSnapshot.of(grid)
