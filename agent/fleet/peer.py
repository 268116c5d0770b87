"""One other robot: the newest of everything it said, in the life it is in, and what is held of its map."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field

from agent.fleet.history import History
from agent.fleet.state import Presence
from agent.fleet.timetable import LONG_AGO_S
from agent.fleet.trust import Trust
from protocol.geometry import SE2
from protocol.grid import OccupancyGrid
from protocol.messages import (
    NO_DIGEST,
    Beat,
    CoarseMap,
    GlobalMeta,
    Hello,
    MapAnnouncement,
    MapVersion,
    Statement,
    Statements,
)
from protocol.tiles import TileMap

_KEPT_PEER_MAPS = 6
_KEPT_REFUSALS = 64


@dataclass(slots=True)
class Ghost:
    """An earlier boot of a robot: if it goes on beating, it is no earlier boot but a twin."""

    last_seq: int
    fresh_beats: int = 0
    heard_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Told:
    """A robot that is gone, as others tell of it (`Estate`)."""

    map: MapVersion
    is_frozen: bool
    witnesses: int  # who held the recipe that names it
    by: frozenset[str]  # who told
    T_global: Mapping[str, SE2]  # where that recipe lays it and everybody else

    def T_between(self, a: str, b: str) -> SE2 | None:
        """T_a_b, as the recipe has it."""
        return self.T_global[a].inverse() @ self.T_global[b] if a in self.T_global and b in self.T_global else None


@dataclass(slots=True)
class Peer:
    """One other robot."""

    robot: str
    boot: int
    heard_s: float
    beat_s: float
    said_s: float = LONG_AGO_S  # when its statements were heard last; older beats say nothing about them
    hello: Hello | None = None
    beat: Beat | None = None
    announcement: MapAnnouncement | None = None
    coarse: CoarseMap | None = None
    meta: GlobalMeta | None = None
    meta_id: bytes = NO_DIGEST  # of `meta`
    meta_s: float = LONG_AGO_S  # when it was heard; older beats may speak of an earlier one
    statements: dict[str, Statement] = field(default_factory=dict)
    statements_seq: int = 0
    statements_digest: bytes | None = None  # over `statements`; None: they changed since
    held: MapVersion | None = None  # the newest version of its cells that is here
    grid: OccupancyGrid | None = None  # the cells of `held`
    area_m2: float = 0.0  # known area of `held`
    admitted: MapVersion | None = None  # the newest version that may enter the global map
    admitted_at: SE2 | None = None  # T_ours_theirs then
    anchor: OccupancyGrid | None = None  # its word: the cells it showed first; newer ones may add to them
    refused: deque[bytes] = field(
        default_factory=lambda: deque(maxlen=_KEPT_REFUSALS)
    )  # digests of versions held back: no recipe may use them
    held_back_s: float | None = None  # since when its newest cells wait
    judged: tuple[object, ...] = ()  # what was looked at when they were held back last
    maps: History = field(default_factory=lambda: History(_KEPT_PEER_MAPS))
    versions: dict[bytes, MapVersion] = field(default_factory=dict)  # of everything in `maps`
    told: Told | None = None  # what others say of it: itself it is gone
    ghosts: dict[int, Ghost] = field(default_factory=dict)
    trust: Trust = field(default_factory=Trust)
    presence: Presence = Presence.ALIVE

    @property
    def map(self) -> MapVersion | None:
        """The newest version it is known to have."""
        beaten, announced = self.beat.map if self.beat else None, self.announcement.map if self.announcement else None
        if beaten is None or announced is None:
            return beaten or announced or (self.told.map if self.told is not None else None)
        return announced if announced.frame == beaten.frame and announced.revision > beaten.revision else beaten

    @property
    def is_in_frame(self) -> bool:
        """Whether we hold cells of the map it draws now."""
        return self.held is not None and self.map is not None and self.held.frame == self.map.frame

    def holds(self, version: MapVersion) -> bool:
        """Whether we hold this version or a later one of the same map."""
        return self.held is not None and self.held.frame == version.frame and self.held.revision >= version.revision

    @property
    def is_frozen(self) -> bool:
        said = self.beat or self.announcement
        if said is None:
            return self.told is not None and self.told.is_frozen
        return said.is_frozen

    @property
    def known_area_m2(self) -> float:
        if self.beat is not None and self.beat.map is not None and self.beat.map == self.map:
            return self.beat.known_area_m2
        return self.announcement.known_area_m2 if self.announcement else 0.0

    @property
    def period_s(self) -> float:
        return self.beat.period_s if self.beat else 1.0

    def add_map(self, version: MapVersion, tiles: TileMap) -> None:
        """One more version of its cells, beside the one that may enter the global map; older ones give way."""
        self.maps.add(tiles, needed=self.admitted.digest if self.admitted is not None else NO_DIGEST)
        here = set(self.maps.digests())
        self.versions = {digest: kept for digest, kept in self.versions.items() if digest in here} | {version.digest: version}

    def hold(self, version: MapVersion, grid: OccupancyGrid) -> None:
        """These are the newest of its cells."""
        self.held, self.grid, self.area_m2 = version, grid, grid.known_area_m2()

    def hear_meta(self, meta: GlobalMeta, now_s: float) -> None:
        self.meta, self.meta_id, self.meta_s = meta, meta.id(), now_s

    def forget_words(self) -> None:
        """A new life: what the old one said is void; its cells stay, they belong to their frame."""
        self.hello = self.beat = self.announcement = self.coarse = self.meta = None
        self.meta_id = NO_DIGEST
        self.statements, self.statements_seq, self.statements_digest = {}, 0, None
        self.told = None

    def still_beats(self, now_s: float) -> bool:
        """Whether the life we know was heard within its period and a half."""
        return self.beat is not None and now_s - self.beat_s < 1.5 * self.period_s

    def take_statements(self, said: Statements) -> list[Statement]:
        """Take over all its statements; those that changed, old and new."""
        if said.seq < self.statements_seq:
            return []
        before, self.statements = self.statements, {statement.other: statement for statement in said.statements}
        self.statements_seq, self.statements_digest = said.seq, None
        after = self.statements
        changed = [other for other in before.keys() | after.keys() if before.get(other) != after.get(other)]
        return [after[other] if other in after else before[other] for other in sorted(changed)]
