"""The fleet logic of one robot: messages, results and time in; effects out.  No clock, no thread, no socket.

Every method takes `now_s` (any monotonic clock) and returns the effects that follow.  All calls must come from one thread.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from agent.fleet.effects import Effect, Fetch, Fuse, Match
from agent.fleet.options import FleetOptions
from agent.fleet.state import FleetState
from protocol.features import FeatureMap
from protocol.geometry import SE2
from protocol.grid import OccupancyGrid
from protocol.messages import Message


class LocalMap(Protocol):
    """What is used of `agent.mapping.MapEstimate`."""

    @property
    def grid(self) -> OccupancyGrid: ...
    @property
    def T_map_robot(self) -> SE2: ...
    @property
    def epoch(self) -> int: ...


class Coordinator:
    """Finds out with whom our map fits, and keeps the one global map of the group."""

    def __init__(self, robot: str, boot_id: int, options: FleetOptions | None = None) -> None:
        """`boot_id`: 64 bits, new at every start of the process."""
        raise NotImplementedError

    def on_local_map(self, estimate: LocalMap, features: FeatureMap, now_s: float) -> Sequence[Effect]:
        """Our own map changed; call as often as you like (at most every `announce_period_s` is announced)."""
        raise NotImplementedError

    def on_pose(self, T_map_robot: SE2, now_s: float) -> None:
        """Where we are in our own map; travels with the next beat."""
        raise NotImplementedError

    def on_message(self, message: Message, now_s: float) -> Sequence[Effect]:
        """A peer said something: already decoded, its `robot` already checked against the key it came on."""
        raise NotImplementedError

    def on_garbage(self, robot: str, reason: str, now_s: float) -> Sequence[Effect]:
        """Bytes came on a key of this robot that no honest robot sends (they did not decode, or named somebody else)."""
        raise NotImplementedError

    def on_fetched(self, fetch: Fetch, message: Message | None, now_s: float) -> Sequence[Effect]:
        """The answer to a `Fetch`; None: nobody answered, or not with what was promised."""
        raise NotImplementedError

    def on_match_done(self, job: Match, result: object, now_s: float) -> Sequence[Effect]:
        """The `MergeResult` of a `Match`; None: the job was dropped."""
        raise NotImplementedError

    def on_fused(self, job: Fuse, fused: object, now_s: float) -> Sequence[Effect]:
        """The `FusedMap` of a `Fuse`; None: the job was dropped."""
        raise NotImplementedError

    def tick(self, now_s: float) -> Sequence[Effect]:
        """Call about ten times a second: beats, retries, presence."""
        raise NotImplementedError

    def unmerge(self, peer: str, now_s: float) -> Sequence[Effect]:
        """The operator takes a peer out of our map, until `readmit`."""
        raise NotImplementedError

    def readmit(self, peer: str, now_s: float) -> Sequence[Effect]:
        """The operator allows a peer again: ends `unmerge` and quarantine."""
        raise NotImplementedError

    def register(self, key: str) -> bytes | None:
        """The encoded answer to a query on our subtree, at most 16 KB; None: there is no such register."""
        raise NotImplementedError

    def state(self, now_s: float) -> FleetState:
        """The fleet as we see it."""
        raise NotImplementedError
