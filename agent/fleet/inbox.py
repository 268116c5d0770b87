"""What peers say and hand out, taken in once it is known to be from this life, newer, and what it claims to be."""

from __future__ import annotations

from agent.fleet.composition import Composition
from agent.fleet.consistency import is_same_drawing
from agent.fleet.estates import Estates
from agent.fleet.fetching import Fetching
from agent.fleet.ledger import Ledger
from agent.fleet.pairs import PairWork
from agent.fleet.peer import Peer
from agent.fleet.state import Presence
from protocol.errors import RemoteProtocolError
from protocol.messages import (
    Beat,
    CoarseMap,
    Estate,
    FineTiles,
    GlobalMeta,
    GlobalTiles,
    Hello,
    MapAnnouncement,
    MapVersion,
    Message,
    Statement,
    Statements,
)


class Inbox:
    """One method for each kind of message."""

    def __init__(self, ledger: Ledger, pairs: PairWork, composition: Composition, estates: Estates, fetching: Fetching) -> None:
        self._ledger, self._pairs, self._composition = ledger, pairs, composition
        self._estates, self._fetching = estates, fetching

    def hear(self, message: Message, now_s: float) -> None:
        """A peer published this."""
        peer = self._ledger.roster.hear(message, now_s)
        self._settle_lives(now_s)
        if peer is None:
            return
        if peer.trust.is_quarantined(now_s) and not isinstance(message, Beat | Hello):
            self._ledger.count("from quarantine")
            return
        match message:
            case Beat():
                self._on_beat(peer, message, now_s)
            case Hello():
                peer.hello = message
            case MapAnnouncement():
                self._on_announcement(peer, message, now_s)
            case Statement():
                self._on_statement(peer, message, now_s)
            case GlobalMeta() if peer.meta is None or message.seq > peer.meta.seq:
                peer.hear_meta(message, now_s)
            case _:
                pass

    def take(self, peer: Peer, message: Message, now_s: float) -> None:
        """A peer answered this when we pulled."""
        match message:
            case MapAnnouncement():
                self._on_announcement(peer, message, now_s)
            case Statements():
                self._on_statements(peer, message, now_s)
            case GlobalMeta() if peer.meta is None or message.seq >= peer.meta.seq:
                peer.hear_meta(message, now_s)
            case CoarseMap():
                peer.coarse = message
            case FineTiles():
                self._on_fine(peer, message, now_s)
            case GlobalTiles():
                self._on_global_tiles(peer, message, now_s)
            case Estate():
                self._on_estate(peer, message, now_s)
            case _:
                pass
        self._settle_lives(now_s)

    def _on_beat(self, peer: Peer, beat: Beat, now_s: float) -> None:
        before, is_back = peer.map, not peer.still_beats(now_s)
        if not self._ledger.roster.accept_beat(peer, beat, now_s):
            return
        if peer.presence is not Presence.ALIVE:
            self._fetching.begin_anew(peer.robot)
        elif is_back:
            self._fetching.forgive(peer.robot)
        self._check_frame(peer, before, now_s)

    def _on_announcement(self, peer: Peer, said: MapAnnouncement, now_s: float) -> None:
        old = peer.announcement
        if old is not None and old.map.frame == said.map.frame and said.map.revision <= old.map.revision:
            return
        before = peer.map
        peer.announcement = said
        self._check_frame(peer, before, now_s)

    def _on_statement(self, peer: Peer, said: Statement, now_s: float) -> None:
        known = peer.statements.get(said.other)
        if known is not None and said.seq <= known.seq:
            if said.seq == known.seq and said != known:
                self._pairs.words.strike(peer, "equivocation", now_s)
            return
        if said.other == self._ledger.robot:
            self._pairs.words.on_proposal(peer, said, now_s)
        elif known is None and len(peer.statements) >= self._ledger.options.max_peers:
            self._ledger.count("statements about too many")
            return
        peer.statements[said.other], peer.statements_digest = said, None
        peer.statements_seq = max(peer.statements_seq, said.seq)
        self._after_statements(peer, [said], now_s)

    def _on_statements(self, peer: Peer, said: Statements, now_s: float) -> None:
        self._after_statements(peer, peer.take_statements(said), now_s)

    def _after_statements(self, peer: Peer, changed: list[Statement], now_s: float) -> None:
        """Judge every edge again of which the peer spoke anew."""
        peer.said_s = now_s
        for statement in changed:
            self._ledger.judge_pair(peer.robot, statement.other, now_s)
        if any(statement.other == self._ledger.robot for statement in changed):
            self._pairs.words.on_said(peer, now_s)
            self._ledger.judge_pair(self._ledger.robot, peer.robot, now_s)
            self._ledger.timetable.next_scan_s = now_s

    def _on_fine(self, peer: Peer, said: FineTiles, now_s: float) -> None:
        """Cells, as a difference to some we hold or to nothing; their digest proves them."""
        base = peer.maps.get(said.delta.base_digest) if said.delta.base_digest else None
        try:
            if said.delta.base_digest and base is None:
                return  # our newest was dropped meanwhile; the next pull asks for everything
            tiles = said.delta.apply(base)
        except RemoteProtocolError as error:
            self._ledger.note("forged-map", is_warning=True, peer=peer.robot, reason=str(error))
            self._pairs.words.strike(peer, "forged map", now_s)
            return
        peer.add_map(said.map, tiles)
        if peer.held is not None and peer.held.frame != said.map.frame:
            peer.anchor, peer.judged = None, ()
            if peer.grid is not None and not is_same_drawing(peer.grid, tiles.grid()):
                self._pairs.words.forget_hint(peer.robot)
        is_newest = peer.held is None or peer.held.frame != said.map.frame or said.map.revision > peer.held.revision
        if is_newest:
            peer.hold(said.map, tiles.grid())

    def _on_global_tiles(self, peer: Peer, said: GlobalTiles, now_s: float) -> None:
        try:
            self._composition.on_tiles(said)
        except RemoteProtocolError:
            self._pairs.words.strike(peer, "forged global map", now_s)

    def _on_estate(self, peer: Peer, said: Estate, now_s: float) -> None:
        try:
            self._estates.take(said, now_s)
        except RemoteProtocolError:
            self._pairs.words.strike(peer, "forged map", now_s)

    def _check_frame(self, peer: Peer, before: MapVersion | None, now_s: float) -> None:
        frame = peer.map.frame if peer.map else None
        if frame is not None and (before is None or before.frame != frame):
            self._pairs.on_new_frame(peer.robot, now_s)

    def _settle_lives(self, now_s: float) -> None:
        """Robots that joined, began a new life, gave way to others, or run twice."""
        roster = self._ledger.roster
        for robot in roster.joined:
            self._ledger.note("peer-joined", peer=robot)
            self._ledger.timetable.next_hello_s = min(self._ledger.timetable.next_hello_s, now_s)
        for robot in roster.restarted:
            self._ledger.note("peer-restarted", peer=robot)
            self._pairs.words.drop_void(robot)
            self._fetching.begin_anew(robot)
            self._ledger.judge_all(robot, now_s)
            for other in self._ledger.peers:
                self._ledger.judge_pair(robot, other, now_s)
            self._ledger.judge_pair(robot, self._ledger.robot, now_s)
        for robot in roster.forgotten:
            self._pairs.words.forget(robot)
            self._fetching.begin_anew(robot)
            self._ledger.judge_all(robot, now_s)
        for robot in roster.twins:
            if self._ledger.count(f"twins of {robot}") == 1:
                self._ledger.note("twin", is_warning=True, peer=robot)
        roster.joined, roster.restarted, roster.forgotten, roster.twins = [], [], [], []
