"""What robots that are gone have left: their maps stay in the global one, and whoever comes later must be able to make it too.

A robot writes below its own name only, so nobody can speak for one that is gone.  Those who hold its words and its cells hand
them on as their own testimony, and a newcomer takes it only for a robot that is not heard, and only the very map that the
recipe of those it is joined to names: two who hold it, where there are two.  Its edges count only where that recipe lays it,
and all who hold the recipe are asked until it is joined: one liar neither invents a robot, nor moves one, nor hides one.  A
robot that speaks again is believed itself.
"""

from __future__ import annotations

from collections.abc import Iterator

from agent.fleet.ledger import Ledger
from agent.fleet.peer import Peer, Told
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
        for teller, member, _, _ in self._missing(now_s):
            yield teller, member
        yield from self._other_versions(now_s)

    def take(self, said: Estate, now_s: float) -> None:
        """Somebody told; what it tells of a robot that is here, or of a map that nobody else holds, is left.

        RemoteProtocolError: the cells are not what they are said to be.
        """
        for teller, member, meta, witnesses in self._missing(now_s):
            if (teller, member.robot, member.map) == (said.robot, said.gone, said.map):
                self._believe(said, meta, witnesses, now_s)
                return
        if any((teller, m.robot, m.map) == (said.robot, said.gone, said.map) for teller, m in self._other_versions(now_s)):
            self._take_cells(self._ledger.peers[said.gone], said)

    def _believe(self, said: Estate, meta: GlobalMeta, witnesses: int, now_s: float) -> None:
        tiles, ledger = said.delta.apply(None), self._ledger
        known = ledger.peers.get(said.gone)
        told = known.told if known is not None else None
        is_more = told is not None and told.map == said.map and told.witnesses == witnesses
        words = dict(known.statements) if known is not None and known.boot == said.gone_boot and (is_more or told is None) else {}
        peer = ledger.roster.gone(said.gone, said.gone_boot, now_s)
        if peer is None:
            return
        by = frozenset({said.robot}) | (told.by if told is not None and is_more else frozenset())
        peer.told = Told(said.map, said.is_frozen, witnesses, by, {member.robot: member.T_global_map for member in meta.members})
        peer.add_map(said.map, tiles)
        peer.hold(said.map, tiles.grid())
        for statement in said.statements:
            if statement.other not in words or statement.seq > words[statement.other].seq:
                words[statement.other] = statement
        peer.statements = words
        ledger.note("estate", peer=said.gone, of=said.robot)
        ledger.judge_all(said.gone, now_s)

    def _take_cells(self, peer: Peer, said: Estate) -> None:
        """One more version of a map that is joined to ours; whether it may enter the global map is asked as of any other."""
        tiles = said.delta.apply(None)
        peer.add_map(said.map, tiles)
        if not peer.holds(said.map):
            peer.hold(said.map, tiles.grid())

    def _other_versions(self, now_s: float) -> Iterator[tuple[str, GlobalMember]]:
        """(who can tell, which map) of robots that died between two pulls: others hold cells that never came here."""
        ledger, group = self._ledger, self._ledger.group
        for teller in self._here(now_s):
            meta = teller.meta
            if group is None or meta is None or len(meta.members) > ledger.options.max_held_maps:
                continue
            for member in meta.members:
                peer = ledger.peers.get(member.robot)
                if peer is None or peer.presence is not Presence.LOST or peer.map is None or member.robot not in group.T_root:
                    continue
                if peer.map.frame == member.map.frame and tiles_of(ledger, member.robot, member.map.digest) is None:
                    yield teller.robot, member

    def _missing(self, now_s: float) -> Iterator[tuple[str, GlobalMember, GlobalMeta, int]]:
        """(who can tell, which map, in which recipe, how many hold it at least)."""
        for meta, tellers in self._witnessed(now_s):
            witnesses = min(_WITNESSES, len(tellers))
            for member in meta.members:
                if self._is_missing(member, meta, witnesses, now_s):
                    silent = self._not_asked(member, witnesses, tellers)
                    yield from ((teller, member, meta, witnesses) for teller in silent)

    def _is_missing(self, member: GlobalMember, meta: GlobalMeta, witnesses: int, now_s: float) -> bool:
        ledger, peer = self._ledger, self._ledger.peers.get(member.robot)
        if member.robot == ledger.robot:
            return False
        if peer is None:
            return sum(peer.told is not None for peer in ledger.peers.values()) < ledger.options.max_told
        if peer.presence is not Presence.LOST or not ledger.is_trusted(peer.robot, now_s):
            return False
        if ledger.group is None or member.robot not in ledger.group.T_root:
            return True
        if peer.told is not None and peer.told.witnesses < witnesses:
            return True  # one alone told, and now there are others
        is_held = len(meta.members) <= ledger.options.max_held_maps  # the group is small enough for all to hold every map
        return is_held and tiles_of(ledger, member.robot, member.map.digest) is None

    def _not_asked(self, member: GlobalMember, witnesses: int, tellers: list[str]) -> list[str]:
        """Who has not told of this version yet, as one of so many."""
        peer = self._ledger.peers.get(member.robot)
        told = peer.told if peer is not None else None
        if told is None or told.map != member.map or told.witnesses < witnesses:
            return tellers
        return [teller for teller in tellers if teller not in told.by]

    def _witnessed(self, now_s: float) -> Iterator[tuple[GlobalMeta, list[str]]]:
        """Recipes of maps that enough of those who are here and joined to us hold, and who they are."""
        here = self._here(now_s)
        metas = {peer.meta_id: peer.meta for peer in here if peer.meta is not None and peer.meta_id != NO_DIGEST}
        for meta_id, meta in metas.items():
            tellers = [peer.robot for peer in here if peer.beat is not None and peer.beat.global_digest == meta_id]
            if tellers and len(tellers) >= min(_WITNESSES, len(here)):
                yield meta, tellers

    def _here(self, now_s: float) -> list[Peer]:
        """Those who are here, believed and joined to us."""
        ledger, group = self._ledger, self._ledger.group
        joined = [ledger.peers[robot] for robot in sorted(group.T_root) if robot in ledger.peers] if group is not None else []
        return [peer for peer in joined if peer.presence is not Presence.LOST and ledger.is_trusted(peer.robot, now_s)]
