"""Everybody else: who is there, and which of a robot's lives is believed."""

from __future__ import annotations

import math

from agent.fleet.options import FleetOptions
from agent.fleet.peer import Ghost, Peer
from agent.fleet.state import Presence
from agent.fleet.timetable import LONG_AGO_S
from protocol.messages import Beat, Hello, MapAnnouncement, Message

_RETIRED_BOOTS = 4


class Roster:
    """All peers, and which of their lives is believed."""

    def __init__(self, options: FleetOptions) -> None:
        self._options = options
        self.peers: dict[str, Peer] = {}
        self.restarted: list[str] = []  # robots whose boot changed since this list was emptied
        self.joined: list[str] = []
        self.unmerged: set[str] = set()  # by the operator, heard or not
        self.twins: list[str] = []  # robots of which two lives speak at once
        self.forgotten: list[str] = []  # robots that gave way to others
        self._look_s = LONG_AGO_S  # nobody's presence changes before

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
            elif peer.still_beats(now_s):
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
        first = min(lost, key=lambda peer: (peer.admitted is not None, peer.heard_s)).robot
        del self.peers[first]
        self.forgotten.append(first)
        return True
