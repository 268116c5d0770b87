"""The fleet as one robot sees it: what status pages, logs and the live view show."""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass, field

from protocol.geometry import SE2
from protocol.messages import Evidence, GlobalMap, MapVersion, Symmetric3


class Presence(enum.Enum):
    ALIVE = "alive"
    SUSPECT = "suspect"  # some beats are missing
    LOST = "lost"  # silent for long; its map stays, marked old


@dataclass(frozen=True, slots=True)
class PeerState:
    """One peer, as known here."""

    robot: str
    presence: Presence
    silent_s: float
    is_frozen: bool
    is_quarantined: bool
    is_unmerged: bool  # by the operator, with `unmerge`
    map: MapVersion | None
    known_area_m2: float
    strikes: int
    T_global_robot: SE2 | None
    pair: str  # "unseen", "coarse", "hopeful", "searching", "ambiguous", "no", "proposed", "verifying", "merged", "withdrawn"
    reason: str
    attempts: int
    match_factor: float


@dataclass(frozen=True, slots=True)
class FrameState:
    """Where one robot's map lies in the global frame of its group."""

    T_global_map: SE2
    covariance: Symmetric3
    age_s: float  # since the robot was last heard


@dataclass(frozen=True, slots=True)
class FleetState:
    """Everything at one moment."""

    robot: str
    is_twin: bool  # another process uses our name, and we are the younger: nothing is published
    root: str  # whose map frame is the global frame of our group; ourselves while alone
    composer: str
    peers: tuple[PeerState, ...]
    frames: Mapping[str, FrameState]  # members of our group
    edges: tuple[Evidence, ...]  # live ones, between any two robots
    rejected_edges: tuple[Evidence, ...]  # live, but at odds with the rest: not used
    global_map: GlobalMap | None
    counts: Mapping[str, int] = field(default_factory=dict)
