"""A robot that is gone and on whose map the others do not agree is let go: one map of all is worth more than a part of it.

Its last words reached some and not others, or its last cells one alone; it cannot be asked again.  Who composes and is followed
by nobody leaves it out, and whoever is joined to a robot that is not in the map of all takes its word about it back.  When it
speaks again, everything is compared anew.
"""

from __future__ import annotations

from collections import deque

from agent.fleet.composition import Composition
from agent.fleet.ledger import Ledger
from agent.fleet.pair_words import PairWords
from agent.fleet.state import Presence

_PATIENCE_S = 30.0  # its estate may still come
_RECENT_S = 20.0  # who holds a map of ours that is no older follows us, as fast as its network lets it


class LettingGo:
    """Watches for how long a robot that is gone divides us."""

    def __init__(self, ledger: Ledger, words: PairWords, composition: Composition) -> None:
        self._ledger, self._words, self._composition = ledger, words, composition
        self._published: deque[tuple[bytes, float]] = deque(maxlen=32)
        self._divides_s: dict[str, float] = {}  # since when

    def check(self, now_s: float) -> None:
        """Call with every scan."""
        ledger, composition = self._ledger, self._composition
        meta, peers = composition.meta, ledger.peers
        if meta is not None and (not self._published or self._published[-1][0] != meta.id()):
            self._published.append((meta.id(), now_s))
        composition.let_go = {robot for robot in composition.let_go if _is_gone(ledger, robot)}
        members = ledger.group.T_root if ledger.group is not None else ()
        gone = [robot for robot in members if robot in peers and _is_gone(ledger, robot)]
        dividing = [robot for robot in gone if not self._is_in_map_of_all(robot, now_s)]
        self._divides_s = {robot: self._divides_s.get(robot, now_s) for robot in dividing}
        for robot in dividing:
            if now_s - self._divides_s[robot] > _PATIENCE_S:
                composition.let_go.add(robot)
                self._words.withdraw(robot, "gone, and not in the map of all", now_s)
                ledger.judge_pair(ledger.robot, robot, now_s)

    def _is_in_map_of_all(self, robot: str, now_s: float) -> bool:
        held, composition = self._composition.global_map, self._composition
        if held is None or all(member.robot != robot for member in held.members):
            return False
        return composition.composer != self._ledger.robot or self._is_followed(now_s)

    def _is_followed(self, now_s: float) -> bool:
        """Whether anybody holds the map that we compose; so does everybody when nobody is there."""
        ledger, group = self._ledger, self._ledger.group
        assert group is not None
        others = [ledger.peers[robot] for robot in group.T_root if robot in ledger.peers and not _is_gone(ledger, robot)]
        recent = {meta_id for meta_id, said_s in self._published if now_s - said_s < _RECENT_S}
        recent |= {self._published[-1][0]} if self._published else set()
        return not others or any(peer.beat is not None and peer.beat.global_digest in recent for peer in others)


def _is_gone(ledger: Ledger, robot: str) -> bool:
    peer = ledger.peers.get(robot)
    return peer is not None and peer.presence is Presence.LOST
