"""Which cells of a member may enter the global map: those that do not take back what it said and others still confirm.

Newer cells that do are held back, and its last agreed version stays in the global map: with one witness until the edge is
verified on them, with two until they no longer contradict.  A map that denies itself is a lie, and its robot is no longer heard.
No composer's recipe may use cells held back here, if two witnesses speak against them or our own map was compared with them: of
one doubt at second hand nothing follows, or large groups of noisy maps would never agree.
"""

from __future__ import annotations

from agent.fleet.broken_word import TakenBack, grown, share_found_again, taken_back, witnessed
from agent.fleet.consistency import agreement
from agent.fleet.ledger import Ledger, pair_key
from agent.fleet.pairs import PairWork
from agent.fleet.peer import Peer
from protocol.geometry import SE2
from protocol.grid import OccupancyGrid
from protocol.messages import Stance

_REDRAWN = 0.15  # share of walls elsewhere: a new drawing, which is taken as its word from then on


class Admission:
    """The gate between pulled cells and the global map."""

    def __init__(self, ledger: Ledger, pairs: PairWork) -> None:
        self._ledger, self._pairs = ledger, pairs

    def admit(self, peer: Peer, now_s: float) -> None:
        """Let a member's newest cells into the global map, or hold them back."""
        assert peer.held is not None and peer.grid is not None
        group, own = self._ledger.group, self._ledger.own
        if group is None or peer.robot not in group.T_root or own.grid is None or own.version is None:
            peer.admitted, peer.held_back_s, peer.judged = peer.held, None, ()  # in no global map of ours
            return
        T_ours_theirs = group.T_root[self._ledger.robot].inverse() @ group.T_root[peer.robot]
        is_checked, is_vouched = self._is_checked(peer), self._is_vouched_for(peer)
        judged = (own.version.digest, peer.held.digest, is_checked, is_vouched, self._is_neighbour(peer))
        if peer.judged == judged and (peer.held_back_s is None or now_s - peer.held_back_s < self._ledger.options.held_back_s):
            self._drop_misplaced(peer, T_ours_theirs)
            return
        peer.judged = judged
        change = taken_back(peer.anchor, peer.grid) if peer.anchor is not None else None
        against = self._witnesses_against(peer, change, now_s) if change is not None else []
        if peer.trust.is_quarantined(now_s):
            return
        is_believed = self._is_believed(peer, against, T_ours_theirs, is_checked=is_checked, is_vouched=is_vouched)
        is_patient = peer.held_back_s is not None and now_s - peer.held_back_s >= self._ledger.options.held_back_s
        if is_believed or (is_patient and is_vouched):
            self._accept(peer, change, T_ours_theirs, is_new_word=is_patient)
        else:
            self._hold_back(peer, T_ours_theirs, len(against), now_s)

    def _is_believed(self, peer: Peer, against: list[str], T_ours_theirs: SE2, *, is_checked: bool, is_vouched: bool) -> bool:
        if len(against) >= 2:
            return False
        if against:
            return is_checked if against == [self._ledger.robot] else is_vouched
        own, pair = self._ledger.own, self._pairs.words.pair(peer.robot)
        if is_checked or not self._is_neighbour(peer):
            return True
        assert own.grid is not None and peer.grid is not None
        share = agreement(own.grid, peer.grid, T_ours_theirs).wall_conflict_share
        return share <= max(pair.conflict_share, 0.0) + self._ledger.options.max_new_conflict

    def _witnesses_against(self, peer: Peer, change: TakenBack, now_s: float) -> list[str]:
        """The robots, ourselves among them, that still see what the newest cells take back."""
        options, against = self._ledger.options, []
        for robot, witness, T_witness_map in self._witnesses(peer):
            said = witnessed(change, witness, T_witness_map)
            if said.plain > options.max_taken_back or said.near > options.max_moved_walls:
                against.append(robot)
        assert peer.grid is not None
        is_denied = len(against) >= 2 and change.share_of_walls >= options.denied_walls
        if is_denied and share_found_again(change.earlier, peer.grid) < options.found_again:
            self._pairs.words.strike(peer, "map denies itself", now_s)
        return against

    def _witnesses(self, peer: Peer) -> list[tuple[str, OccupancyGrid, SE2]]:
        """Everybody of our group whose word is here: their cells as first shown, and T_witness_map of the peer's map."""
        ledger, group = self._ledger, self._ledger.group
        assert group is not None and ledger.own.grid is not None
        T_root_peer = group.T_root[peer.robot]
        found = [(ledger.robot, ledger.own.grid, group.T_root[ledger.robot].inverse() @ T_root_peer)]
        for robot, T_root in sorted(group.T_root.items()):
            other = ledger.peers.get(robot)
            if other is not None and other is not peer and other.anchor is not None and other.held_back_s is None:
                found.append((robot, other.anchor, T_root.inverse() @ T_root_peer))
        return found

    def _accept(self, peer: Peer, change: TakenBack | None, T_ours_theirs: SE2, *, is_new_word: bool) -> None:
        assert peer.grid is not None
        is_redrawn = change is not None and change.share_of_walls > _REDRAWN
        if peer.anchor is None or is_redrawn or is_new_word:
            peer.anchor = peer.grid
        else:
            peer.anchor = grown(peer.anchor, peer.grid)
        if peer.held_back_s is not None:
            self._ledger.note("taken-in-again", peer=peer.robot)
        peer.admitted, peer.admitted_at, peer.held_back_s = peer.held, T_ours_theirs, None
        if peer.held is not None and peer.held.digest in peer.refused:
            peer.refused.remove(peer.held.digest)

    def _hold_back(self, peer: Peer, T_ours_theirs: SE2, witnesses: int, now_s: float) -> None:
        assert peer.held is not None
        if peer.held_back_s is None:
            peer.held_back_s = now_s
            self._ledger.note("held-back", is_warning=True, peer=peer.robot, witnesses=witnesses)
        if (witnesses >= 2 or self._has_compared(peer)) and peer.held.digest not in peer.refused:
            peer.refused.append(peer.held.digest)
        self._pairs.words.pair(peer.robot).is_urgent = self._is_neighbour(peer)
        self._drop_misplaced(peer, T_ours_theirs)

    def _drop_misplaced(self, peer: Peer, T_ours_theirs: SE2) -> None:
        """An agreed version lies where it lay: when the edge has moved since, it belongs nowhere."""
        if (
            peer.admitted != peer.held
            and peer.admitted_at is not None
            and not self._ledger.is_same(peer.admitted_at, T_ours_theirs)
        ):
            peer.admitted = None

    def _is_neighbour(self, peer: Peer) -> bool:
        return pair_key(self._ledger.robot, peer.robot) in self._ledger.live

    def _has_compared(self, peer: Peer) -> bool:
        """Whether our own maps have told about it: by an edge that lives, or by one that we took back."""
        said = self._ledger.mine.get(peer.robot)
        return self._is_neighbour(peer) or (said is not None and said.stance is Stance.WITHDRAW)

    def _is_checked(self, peer: Peer) -> bool:
        """Whether our own edge with it was found good on these very maps."""
        own, pair = self._ledger.own.version, self._pairs.words.pair(peer.robot)
        assert own is not None and peer.held is not None
        return self._is_neighbour(peer) and pair.checked_digests == (own.digest, peer.held.digest) and pair.failures == 0

    def _is_vouched_for(self, peer: Peer) -> bool:
        """Whether a live edge was checked on the cells we hold, or on later ones."""
        assert peer.held is not None
        for key, evidence in self._ledger.live.items():
            if peer.robot in key:
                cited = evidence.map_a if peer.robot == evidence.robot_a else evidence.map_b
                if cited.frame == peer.held.frame and cited.revision >= peer.held.revision:
                    return True
        return False
