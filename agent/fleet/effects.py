"""What the coordinator wants done: values, to be carried out by the runtime (or by the simulation).

Send     publish on my own subtree; may be lost, is never waited for
Fetch    pull a register of a peer; answer with `Coordinator.on_fetched`, None when it failed
Match    compare two maps; answer with `Coordinator.on_match_done`
Fuse     lay maps over one another; answer with `Coordinator.on_fused`
Changed  there is a new global map (or none any more): show it, save it
Note     something to log or to keep as a record: an event and its facts
"""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from protocol.geometry import SE2
from protocol.grid import OccupancyGrid
from protocol.messages import GlobalMap, Message


@dataclass(frozen=True, slots=True, eq=False)
class Send:
    """Publish this message where `protocol.channels` says; congestion drops it."""

    message: Message


@dataclass(frozen=True, slots=True)
class Fetch:
    """Pull `key`, a register below `peer`'s subtree, and decode it; chunks of a manifest are joined by the runtime."""

    id: int
    peer: str
    key: str  # as in protocol.channels: "map/coarse", "map/fine/<base>/<target>", ...
    is_bulk: bool  # at most two of these run at a time; small ones overtake them


class MatchKind(enum.Enum):
    COARSE = "coarse"  # match_maps on 20 cm maps: is the fine map worth pulling?
    SEARCH = "search"  # match_maps on the fine maps
    VERIFY = "verify"  # verify_match at T_ours_theirs


@dataclass(frozen=True, slots=True, eq=False)
class Match:
    """Compare our map with a peer's; snapshots of either may be cached under its digest."""

    id: int
    kind: MatchKind
    peer: str
    ours: OccupancyGrid
    theirs: OccupancyGrid
    ours_digest: bytes
    theirs_digest: bytes
    T_ours_theirs: SE2 | None = None  # VERIFY: the transform in question


@dataclass(frozen=True, slots=True, eq=False)
class Fuse:
    """Make the global map: `agent.merging.fuse(maps, resolution_m)`."""

    id: int
    maps: tuple[tuple[OccupancyGrid, SE2], ...]  # each with its T_global_map
    resolution_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Changed:
    """The global map this robot holds is now this one; None: it is alone again."""

    global_map: GlobalMap | None


@dataclass(frozen=True, slots=True)
class Note:
    """For the log and the records: `merged peer=r2 factor=0.97 ...`."""

    event: str  # "merge-attempt", "merged", "withdrawn", "peer-joined", "peer-lost", "quarantined", "twin", ...
    facts: Mapping[str, Any] = field(default_factory=dict)
    is_warning: bool = False


Effect = Send | Fetch | Match | Fuse | Changed | Note
