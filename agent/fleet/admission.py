"""Which cells of a member may enter the global map: those that contradict neither its own earlier ones nor ours.

Cells that do wait for a check of the edge, and the last good version stays in the global map meanwhile.
"""

from __future__ import annotations

from agent.fleet.consistency import agreement
from agent.fleet.ledger import Ledger, pair_key
from agent.fleet.members import Peer
from agent.fleet.pairs import PairWork
from protocol.geometry import SE2


class Admission:
    """The gate between pulled cells and the global map."""

    def __init__(self, ledger: Ledger, pairs: PairWork) -> None:
        self._ledger, self._pairs = ledger, pairs

    def admit(self, peer: Peer, now_s: float) -> None:
        """Let a member's new cells into the global map, unless they contradict its own earlier ones, or ours."""
        assert peer.held is not None and peer.grid is not None
        group, own = self._ledger.group, self._ledger.own
        if group is None or peer.robot not in group.T_root or own.grid is None or own.version is None:
            self._accept(peer)
            return
        judged = (own.version.digest, peer.held.digest)
        pair = self._pairs.words.pair(peer.robot)
        is_neighbour = pair_key(self._ledger.robot, peer.robot) in self._ledger.live
        is_checked = is_neighbour and pair.checked_digests == judged and pair.failures == 0
        if is_checked or (not is_neighbour and self._is_vouched_for(peer)):
            self._accept(peer)
            return
        if peer.judged == judged:
            return  # contradicts; waits for a check
        peer.judged = judged
        moved = agreement(peer.anchor, peer.grid, SE2.identity()) if peer.anchor is not None else None
        if moved is not None and moved.walls >= 40 and moved.wall_conflict_share > self._ledger.options.broken_word_share:
            self._pairs.words.strike(peer, "map broke its word", now_s)
            self._ledger.lay_out(now_s)
            peer.refused, pair.is_urgent = peer.held.digest, is_neighbour
            return
        is_steady = moved is None or moved.wall_conflict_share <= self._ledger.options.max_self_conflict
        if not is_neighbour:
            if is_steady:
                self._accept(peer)
            return
        T_ours_theirs = group.T_root[self._ledger.robot].inverse() @ group.T_root[peer.robot]
        against = agreement(own.grid, peer.grid, T_ours_theirs).wall_conflict_share
        if is_steady and against <= max(pair.conflict_share, 0.0) + self._ledger.options.max_new_conflict:
            self._accept(peer)
        else:
            peer.refused, pair.is_urgent = peer.held.digest, True

    def _accept(self, peer: Peer) -> None:
        peer.admitted, peer.refused = peer.held, b""
        group = self._ledger.group
        if peer.anchor is None or group is None or self._is_vouched_for(peer):
            peer.anchor = peer.grid

    def _is_vouched_for(self, peer: Peer) -> bool:
        """Whether a live edge was checked on the cells we hold, or on later ones."""
        assert peer.held is not None
        for key, evidence in self._ledger.live.items():
            if peer.robot in key:
                cited = evidence.map_a if peer.robot == evidence.robot_a else evidence.map_b
                if cited.frame == peer.held.frame and cited.revision >= peer.held.revision:
                    return True
        return False
