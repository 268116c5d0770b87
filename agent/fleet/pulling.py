"""What is missing here: small registers whose version in a beat is not ours, and the maps that pairs and composition wait for."""

from __future__ import annotations

from agent.fleet.composition import Composition
from agent.fleet.estates import Estates
from agent.fleet.fetching import Fetching
from agent.fleet.ledger import Ledger, statements_digest
from agent.fleet.pairs import PairWork
from agent.fleet.peer import Peer
from agent.fleet.state import Presence
from protocol.channels import estate_register, fine_register, global_register
from protocol.messages import NO_DIGEST

_GRACE_S = 0.4  # a beat may overtake the hint it speaks of


class Pulling:
    """Compares what peers say they have with what is here."""

    def __init__(self, ledger: Ledger, pairs: PairWork, composition: Composition, estates: Estates, fetching: Fetching) -> None:
        self._ledger, self._pairs, self._composition = ledger, pairs, composition
        self._estates, self._fetching = estates, fetching

    def pull_words(self, peer: Peer, now_s: float) -> None:
        """Small registers whose version in the beat is not the one we hold."""
        beat = peer.beat
        if beat is None or peer.presence is Presence.LOST or now_s - peer.beat_s < _GRACE_S:
            return
        if not self._ledger.is_trusted(peer.robot, now_s):
            return
        if beat.map is not None and (peer.announcement is None or peer.announcement.map.frame != beat.map.frame):
            self._fetching.want(peer.robot, "feat", "map/feat", now_s)
        if peer.statements_digest is None:
            peer.statements_digest = statements_digest(peer.statements.values())
        if peer.beat_s >= peer.said_s and beat.edges_digest != peer.statements_digest:
            self._fetching.want(peer.robot, "edges", "edges", now_s)
        is_wanted = peer.robot == self._composition.composer or self._composition.awaits_meta(peer.robot)
        if is_wanted and peer.beat_s >= peer.meta_s and beat.global_digest not in (NO_DIGEST, peer.meta_id):
            self._fetching.want(peer.robot, "global", "global/meta", now_s)

    def pull_maps(self, turn: list[Peer], now_s: float) -> None:
        missing = self._composition.step(now_s)
        for robot, digest in missing:
            peer = self._ledger.peers.get(robot)
            if peer is not None and peer.presence is not Presence.LOST:
                self._pull_fine(peer, digest, now_s)
        for teller, member in self._estates.wanted(now_s):
            self._fetching.want(teller, "estate", estate_register(member.robot, member.map.digest), now_s)
        tiles = self._composition.wanted_tiles()
        if tiles is not None:
            base = self._composition.history.newest
            key = global_register(base.digest if base else NO_DIGEST, tiles[1])
            self._fetching.want(tiles[0], "tiles", key, now_s)
        for peer in turn:
            pair = self._pairs.pairs.get(peer.robot)
            if pair is None or peer.presence is Presence.LOST:
                continue
            if pair.wants_fine:
                self._pull_fine(peer, NO_DIGEST, now_s)
            elif pair.wants_coarse:
                self._fetching.want(peer.robot, "coarse", "map/coarse", now_s)

    def _pull_fine(self, peer: Peer, target: bytes, now_s: float) -> None:
        if peer.map is None or (target == NO_DIGEST and peer.held == peer.map):
            return
        newest = peer.maps.newest
        is_same_frame = peer.held is not None and peer.held.frame == peer.map.frame
        base = newest.digest if newest is not None and is_same_frame else NO_DIGEST
        self._fetching.want(peer.robot, "fine", fine_register(base, target), now_s)
