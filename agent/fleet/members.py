"""Everyone else: who is there, in which life, and the newest of everything they said."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field

from agent.fleet.history import History
from agent.fleet.options import FleetOptions
from agent.fleet.state import Presence
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
    Message,
    Statement,
    Statements,
)

_RETIRED_BOOTS = 4
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
    said_s: float = -1e18  # when its statements were heard last; older beats say nothing about them
    hello: Hello | None = None
    beat: Beat | None = None
    announcement: MapAnnouncement | None = None
    coarse: CoarseMap | None = None
    meta: GlobalMeta | None = None
    meta_id: bytes = NO_DIGEST  # of `meta`
    meta_s: float = -1e18  # when it was heard; older beats may speak of an earlier one
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
    )  # versions held back: no recipe may use them
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

    def hold(self, version: MapVersion, tiles_grid: OccupancyGrid) -> None:
        self.held, self.grid = version, tiles_grid
        self.area_m2 = tiles_grid.known_area_m2()
        self.versions[version.digest] = version
        alive = set(self.maps.digests())
        self.versions = {digest: kept for digest, kept in self.versions.items() if digest in alive}

    def hear_meta(self, meta: GlobalMeta, now_s: float) -> None:
        self.meta, self.meta_id, self.meta_s = meta, meta.id(), now_s

    def forget_words(self) -> None:
        """A new life: what the old one said is void; its cells stay, they belong to their frame."""
        self.hello = self.beat = self.announcement = self.coarse = self.meta = None
        self.meta_id = NO_DIGEST
        self.statements, self.statements_seq, self.statements_digest = {}, 0, None
        self.told = None


class Roster:
    """All peers, and which of their lives is believed."""

    def __init__(self, options: FleetOptions) -> None:
        self._options = options
        self.peers: dict[str, Peer] = {}
        self.restarted: list[str] = []  # robots whose boot changed since this list was emptied
        self.joined: list[str] = []
        self.unmerged: set[str] = set()  # by the operator, heard or not
        self.twins: list[str] = []  # robots of which two lives speak at once
        self._look_s = -1e18  # nobody's presence changes before

    def hear(self, message: Message, now_s: float) -> Peer | None:
        """The peer this message may change; None when it is from a life that is over, or the table is full."""
        peer = self.peers.get(message.robot)
        if peer is None:
            if len(self.peers) >= self._options.max_peers and not self._make_room():
                return None
            peer = self.peers[message.robot] = Peer(message.robot, message.boot, now_s, now_s)
            self.joined.append(peer.robot)
            self._look_s = min(self._look_s, self._next_change_s(peer))
        if message.boot != peer.boot:
            if message.boot in peer.ghosts:
                if not self._ghost_lives(peer, message, now_s):
                    return None
            elif not isinstance(message, Beat | Hello | MapAnnouncement):
                return None  # a new life introduces itself first
            elif still_beats(peer, now_s):
                return None  # a twin, perhaps: the life that is known is believed until it misses a beat
            self._reborn(peer, message.boot, now_s)
        if peer.told is not None:
            peer.forget_words()  # others said them
        peer.heard_s = now_s
        return peer

    def gone(self, robot: str, boot: int, now_s: float) -> Peer | None:
        """The entry of a robot that others tell of and nobody hears, without its words; None when the table is full."""
        peer = self.peers.get(robot)
        if peer is None:
            if len(self.peers) >= self._options.max_peers and not self._make_room():
                return None
            lost_s = now_s - self._options.lost_after_s
            peer = self.peers[robot] = Peer(robot, boot, lost_s, lost_s, presence=Presence.LOST)
        peer.forget_words()
        peer.boot = boot
        return peer

    def accept_beat(self, peer: Peer, beat: Beat, now_s: float) -> bool:
        """Take the beat unless a newer one is here already."""
        if peer.beat is not None and beat.seq <= peer.beat.seq:
            return False
        peer.beat, peer.beat_s = beat, now_s
        self._look_s = min(self._look_s, self._next_change_s(peer) if peer.presence is Presence.ALIVE else now_s)
        return True

    def update_presence(self, now_s: float) -> list[Peer]:
        """Judge silence; the peers whose presence changed."""
        if now_s < self._look_s:
            return []
        changed = []
        for peer in self.peers.values():
            presence = self._presence(peer, now_s)
            if presence is not peer.presence:
                peer.presence = presence
                changed.append(peer)
        self._look_s = min(map(self._next_change_s, self.peers.values()), default=now_s)
        return changed

    def _presence(self, peer: Peer, now_s: float) -> Presence:
        silent_s = now_s - peer.beat_s
        if silent_s > self._lost_after_s(peer):
            return Presence.LOST
        return Presence.SUSPECT if silent_s > self._options.suspect_after_beats * peer.period_s else Presence.ALIVE

    def _lost_after_s(self, peer: Peer) -> float:
        return max(self._options.lost_after_s, 5.0 * peer.period_s)

    def _next_change_s(self, peer: Peer) -> float:
        """The earliest moment at which this peer may be judged otherwise, unless it speaks; a beat may revive the silent."""
        suspect_s = peer.beat_s + self._options.suspect_after_beats * peer.period_s
        lost_s = peer.beat_s + self._lost_after_s(peer)
        return {Presence.ALIVE: min(suspect_s, lost_s), Presence.SUSPECT: lost_s, Presence.LOST: math.inf}[peer.presence]

    def _reborn(self, peer: Peer, boot: int, now_s: float) -> None:
        peer.ghosts.pop(boot, None)
        peer.ghosts[peer.boot] = Ghost(peer.beat.seq if peer.beat else 0)
        while len(peer.ghosts) > _RETIRED_BOOTS:
            del peer.ghosts[next(iter(peer.ghosts))]
        peer.boot = boot
        peer.forget_words()
        self._look_s = now_s
        self.restarted.append(peer.robot)

    def _ghost_lives(self, peer: Peer, message: Message, now_s: float) -> bool:
        """An earlier life that keeps beating while the later one is silent was the right one all along."""
        ghost = peer.ghosts[message.boot]
        if not isinstance(message, Beat) or message.seq <= ghost.last_seq:
            return False
        ghost.last_seq = message.seq
        if now_s - ghost.heard_s > 0.5 * message.period_s:  # late beats come in bursts and do not count
            ghost.fresh_beats, ghost.heard_s = ghost.fresh_beats + 1, now_s
        if ghost.fresh_beats >= 3:
            self.twins.append(peer.robot)
        return ghost.fresh_beats >= 3 and now_s - peer.beat_s > 2.0 * message.period_s

    def _make_room(self) -> bool:
        """Forget the longest lost peer, of those first whose cells we never took in; who is here is not pushed out."""
        lost = [peer for peer in self.peers.values() if peer.presence is Presence.LOST]
        if not lost:
            return False
        del self.peers[min(lost, key=lambda peer: (peer.admitted is not None, peer.heard_s)).robot]
        return True


def still_beats(peer: Peer, now_s: float) -> bool:
    """Whether the life we know was heard within its period and a half."""
    return peer.beat is not None and now_s - peer.beat_s < 1.5 * peer.period_s


def newer_statements(peer: Peer, said: Statements) -> list[Statement]:
    """Take over all statements of a peer; those that changed, old and new."""
    if said.seq < peer.statements_seq:
        return []
    before, peer.statements = peer.statements, {statement.other: statement for statement in said.statements}
    peer.statements_seq, peer.statements_digest = said.seq, None
    after = peer.statements
    changed = [other for other in before.keys() | after.keys() if before.get(other) != after.get(other)]
    return [after[other] if other in after else before[other] for other in sorted(changed)]
