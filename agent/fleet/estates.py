"""What robots that are gone have left: their maps stay in the global one, and whoever comes later must be able to make it too.

A robot writes below its own name only, so nobody can speak for one that is gone.  Those who hold its words and its cells hand
them on as their own testimony, and a newcomer takes it only for a robot that is not heard, and only the very map that the
recipes of those it is joined to name: two of them, where there are two.  A robot that speaks again is believed itself.
"""

from __future__ import annotations

from collections.abc import Iterator

from agent.fleet.ledger import Ledger
from agent.fleet.members import Peer
from agent.fleet.recipe import tiles_of
from agent.fleet.state import Presence
from protocol.messages import NO_DIGEST, Estate, GlobalMember, GlobalMeta
from protocol.tiles import TileDelta

_WITNESSES = 2  # who hold the same global map: one liar cannot invent a robot


class Estates:
    """Told to others, asked of others."""

    def __init__(self, ledger: Ledger) -> None:
        self._ledger = ledger

    def of(self, gone: str, digest: bytes) -> Estate | None:
        """What we hold of a robot that is not heard any more; None when we hold nothing, or it can speak for itself."""
        peer = self._ledger.peers.get(gone)
        if peer is None or peer.presence is not Presence.LOST:
            return None
        tiles, version = peer.maps.get(digest), peer.versions.get(digest)
        if tiles is None or version is None:
            return None
        ledger, words = self._ledger, tuple(peer.statements[other] for other in sorted(peer.statements))
        return Estate(ledger.robot, ledger.boot, gone, peer.boot, peer.is_frozen, words, version, TileDelta.between(None, tiles))

    def wanted(self, now_s: float) -> Iterator[tuple[str, GlobalMember]]:
        """(who can tell, which map) of robots that are gone and whose maps are in the global map, but not here."""
        for meta in self._witnessed(now_s):
            for member in meta.members:
                if self._is_missing(member, now_s, is_held=len(meta.members) <= self._ledger.options.max_held_maps):
                    yield meta.robot, member

    def take(self, said: Estate, now_s: float) -> None:
        """Somebody told; what it tells of a robot that is here, or of a map that nobody else holds, is left.

        RemoteProtocolError: the cells are not what they are said to be.
        """
        named = (member for teller, member in self.wanted(now_s) if teller == said.robot and member.robot == said.gone)
        if not any(member.map == said.map for member in named):
            return
        tiles = said.delta.apply(None)
        peer = self._ledger.roster.gone(said.gone, said.gone_boot, now_s)
        if peer is None:
            return
        peer.told, peer.is_told_frozen = said.map, said.is_frozen
        peer.maps.add(tiles)
        peer.hold(said.map, tiles.grid())
        peer.statements = {statement.other: statement for statement in said.statements}
        self._ledger.note("estate", peer=said.gone, of=said.robot)
        self._ledger.judge_all(said.gone, now_s)

    def _is_missing(self, member: GlobalMember, now_s: float, *, is_held: bool) -> bool:
        """`is_held`: the group is small enough for everybody to hold every map."""
        ledger, peer = self._ledger, self._ledger.peers.get(member.robot)
        if member.robot == ledger.robot:
            return False
        if peer is None:
            return True
        if peer.presence is not Presence.LOST or peer.told == member.map or not ledger.is_trusted(peer.robot, now_s):
            return False
        group = ledger.group
        is_joined = group is not None and member.robot in group.T_root
        return not is_joined or (is_held and tiles_of(ledger, member.robot, member.map.digest) is None)

    def _witnessed(self, now_s: float) -> list[GlobalMeta]:
        """Recipes of maps that enough of those who are here and joined to us hold."""
        ledger, group = self._ledger, self._ledger.group
        if group is None:
            return []
        joined = [ledger.peers[robot] for robot in sorted(group.T_root) if robot in ledger.peers]
        here = [peer for peer in joined if peer.presence is not Presence.LOST and ledger.is_trusted(peer.robot, now_s)]
        enough = min(_WITNESSES, len(here))
        return [peer.meta for peer in here if peer.meta is not None and _holders(here, peer.meta_id) >= enough]


def _holders(here: list[Peer], meta_id: bytes) -> int:
    held = [peer.beat.global_digest for peer in here if peer.beat is not None]
    return held.count(meta_id) if meta_id != NO_DIGEST else 0
