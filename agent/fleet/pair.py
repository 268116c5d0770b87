"""What one robot remembers of one pair: what was compared, on how much map, and what came of it."""

from __future__ import annotations

import enum
from dataclasses import dataclass

from agent.fleet.effects import Match
from agent.fleet.timetable import LONG_AGO_S
from protocol.geometry import SE2
from protocol.messages import Evidence, MapVersion


class Purpose(enum.Enum):
    """Why a comparison is made."""

    COARSE = "coarse"
    SEARCH = "search"
    HINT = "hint"  # a transform that held before a map was redrawn
    LOOP = "loop"  # the frames of our group predict a transform for a pair without an edge
    PROPOSAL = "proposal"  # the other side says so
    RECHECK = "recheck"  # an edge lives; does it still?


@dataclass(slots=True)
class Attempt:
    """When a comparison was made last, and on how much map."""

    at_s: float
    area_m2: float
    digests: tuple[bytes, bytes] = (b"", b"")  # of ours and theirs


@dataclass(slots=True)
class Pair:
    """Our side of one pair."""

    peer: str
    phase: str = "unseen"
    reason: str = ""
    attempts: int = 0
    match_factor: float = 0.0
    coarse: Attempt | None = None
    coarse_map: MapVersion | None = None  # of theirs, compared last
    coarse_misses: int = 0
    search: Attempt | None = None
    loop: Attempt | None = None
    checked: Attempt | None = None
    checked_digests: tuple[bytes, bytes] = (b"", b"")
    conflict_share: float = -1.0  # of the walls, when the edge was first found good; negative: not yet
    failures: int = 0  # checks of the live edge that failed, in a row
    is_urgent: bool = False  # the newest cells contradict the edge
    renewed_s: float = LONG_AGO_S
    hint: SE2 | None = None  # T_ours_theirs that held before a frame was drawn anew
    refused: Evidence | None = None  # evidence of theirs that we checked and did not find true
    refusals: int = 0  # in a row
    refused_s: float = 0.0
    promise: float = 0.0  # how alike the features are: whom to look at first
    promise_of: tuple[int, int] = (-1, -1)  # revisions it was computed from; in a new frame the pair is a new one
    is_courted: bool = False  # its maps may be pulled
    wants_coarse: bool = False
    wants_fine: bool = False


@dataclass(frozen=True, slots=True)
class Due:
    """A comparison that could be made now."""

    purpose: Purpose
    evidence: Evidence | None = None  # whose claim is checked
    T_ours_theirs: SE2 | None = None  # to be verified; None: to be searched


@dataclass(frozen=True, slots=True)
class Running:
    """The comparison under way, and the versions it is made on."""

    job: Match
    purpose: Purpose
    ours: MapVersion
    theirs: MapVersion
    evidence: Evidence | None
    area_m2: float
    since_s: float
