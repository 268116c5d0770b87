"""Which comparison comes next: the most urgent that is due, with whom the features promise most.

A pair that does not fit is tried again when a map has grown, not when a clock has ticked.  What has to be pulled before a
pair can be compared is noted in the pair, for `Pulling`.
"""

from __future__ import annotations

import heapq

import numpy as np

from agent.fleet.ledger import Ledger, pair_key, supported
from agent.fleet.pair import Attempt, Due, Pair, Purpose
from agent.fleet.pair_words import PairWords
from agent.fleet.peer import Peer
from agent.fleet.state import Presence
from protocol.features import LINE_COLUMNS, FeatureMap
from protocol.messages import Evidence, MapVersion, Stance, Statement

_LENGTH_COLUMN = LINE_COLUMNS.index("length_m")
_LONGEST_DOUBT_S = 60.0  # between two checks of proposals of a peer whose last ones were refused

_URGENCY = {
    Purpose.PROPOSAL: 0,
    Purpose.RECHECK: 1,
    Purpose.HINT: 2,
    Purpose.SEARCH: 3,
    Purpose.COARSE: 4,
    Purpose.LOOP: 5,
}


class PairChoice:
    """Chooses among all pairs."""

    def __init__(self, ledger: Ledger, words: PairWords) -> None:
        self._ledger, self._words = ledger, words
        self._tokens, self._tokens_s = float(ledger.options.strangers_at_once), 0.0
        self._promising: set[str] | None = None  # strangers to be looked at now; None: whoever has its turn

    def next(self, peers: list[Peer], now_s: float) -> tuple[Peer, Due] | None:
        """Update what each pair waits for; the most urgent comparison, of equals the one that has waited longest."""
        self._refill(now_s)
        self._promising = self._most_promising() if len(peers) < len(self._ledger.peers) else None
        ordered = sorted(peers, key=lambda peer: -self._promise(peer))
        options = [(peer, due) for peer in ordered if (due := self._option(peer, now_s)) is not None]
        return min(options, key=lambda option: self._rank(*option), default=None)

    def _rank(self, peer: Peer, due: Due) -> tuple[int, float, str]:
        pair = self._words.pair(peer.robot)
        attempt = pair.search or pair.coarse
        return _URGENCY[due.purpose], attempt.at_s if attempt else 0.0, peer.robot

    def _option(self, peer: Peer, now_s: float) -> Due | None:
        """What could be compared with this peer now; notes what has to be pulled for it."""
        pair = self._words.pair(peer.robot)
        pair.wants_coarse = pair.wants_fine = False
        if self._ledger.own.version is None or peer.map is None or not self._ledger.is_trusted(peer.robot, now_s):
            return None
        return self._due(pair, peer, now_s)

    def _due(self, pair: Pair, peer: Peer, now_s: float) -> Due | None:
        ledger = self._ledger
        said = peer.statements.get(ledger.robot)
        mine = ledger.mine.get(peer.robot)
        if said is not None and self._must_verify(pair, said, mine, now_s):
            theirs = said.evidence.map_a if peer.robot == said.evidence.robot_a else said.evidence.map_b
            if not peer.holds(theirs):
                pair.wants_fine = True
                return None
            return Due(Purpose.PROPOSAL, said.evidence, self._ledger.from_our_side(said.evidence))
        live = ledger.live.get(pair_key(ledger.robot, peer.robot))
        if live is not None:
            if peer.is_in_frame and self._is_recheck_due(pair, peer, now_s):
                return Due(Purpose.RECHECK, live, self._ledger.from_our_side(live))
            return None
        if mine is not None and mine.stance is Stance.PROPOSE and not self._is_answered(mine, said):
            return None  # the other side has not spoken yet
        if not self._may_propose(peer):
            return None
        group = ledger.group
        if group is not None and peer.robot in group.T_root:
            return self._loop(pair, peer, now_s)
        return self._approach(pair, peer, now_s)

    def _loop(self, pair: Pair, peer: Peer, now_s: float) -> Due | None:
        """A pair of our own group without an edge: one more edge makes one more loop to check the others by."""
        group = self._ledger.group
        assert group is not None
        if not peer.is_in_frame or not self._is_due(pair.loop, self.area_m2(peer), peer.held, now_s):
            return None
        if sum(self._ledger.robot in key for key in self._ledger.live) >= self._ledger.options.max_edges:
            return None
        return Due(Purpose.LOOP, None, group.T_root[self._ledger.robot].inverse() @ group.T_root[peer.robot])

    def _approach(self, pair: Pair, peer: Peer, now_s: float) -> Due | None:
        """A stranger: the coarse map first, the cells when that looks hopeful, then the search."""
        options, hint = self._ledger.options, self._words.hint(peer.robot)
        if peer.is_in_frame:
            if not self._is_due(pair.search, self._ledger.own.known_area_m2 + peer.known_area_m2, peer.map, now_s):
                return None
            if peer.held != peer.map:
                pair.wants_fine = True  # grown since: search on the newest
                if not self._is_due(pair.search, self.area_m2(peer), peer.held, now_s):
                    return None
            return Due(Purpose.HINT, None, hint) if hint else Due(Purpose.SEARCH)
        announced = peer.announcement
        if announced is None or not self._may_court(pair):
            return None
        if hint or announced.fine_bytes <= options.coarse_skip_bytes or pair.phase == "hopeful" or pair.coarse_misses >= 3:
            pair.wants_fine = True
            return None
        if not self._is_due(pair.coarse, self._ledger.own.known_area_m2 + peer.known_area_m2, peer.map, now_s):
            return None
        if (
            peer.coarse is None
            or peer.map is None
            or peer.coarse.map.frame != peer.map.frame
            or peer.coarse.map == pair.coarse_map
        ):
            pair.wants_coarse = True
            return None
        return Due(Purpose.COARSE)

    def _may_court(self, pair: Pair) -> bool:
        """Strangers are looked at a few a minute: in a fleet of a thousand nobody can look at everybody at once."""
        is_wanted = self._promising is None or pair.peer in self._promising
        if not pair.is_courted and is_wanted and self._tokens >= 1.0:
            self._tokens -= 1.0
            pair.is_courted = True
        return pair.is_courted

    def _most_promising(self) -> set[str]:
        """As many as may be looked at now: the best of all strangers, not of the few whose turn it is."""
        strangers = [peer for peer in self._ledger.peers.values() if not self._words.pair(peer.robot).is_courted]
        hopeful = [peer for peer in strangers if self._may_propose(peer)] if self._tokens >= 1.0 else []
        return {peer.robot for peer in heapq.nlargest(int(self._tokens), hopeful, key=self._promise)}

    def _refill(self, now_s: float) -> None:
        options = self._ledger.options
        gained = (now_s - self._tokens_s) / 60.0 * options.strangers_per_minute
        self._tokens, self._tokens_s = min(self._tokens + gained, float(options.strangers_at_once)), now_s

    def _promise(self, peer: Peer) -> float:
        """How much wall of our features has a like in theirs; strangers that promise most come first."""
        ours, theirs = self._ledger.own.announcement, peer.announcement
        if ours is None or theirs is None:
            return 0.0
        pair, of = self._words.pair(peer.robot), (ours.map.revision, theirs.map.revision)
        if pair.promise_of != of:
            pair.promise, pair.promise_of = common_length_m(ours.features, theirs.features), of
        return pair.promise

    def _must_verify(self, pair: Pair, said: Statement, mine: Statement | None, now_s: float) -> bool:
        """Whether they propose something we have not judged, and that outranks what we propose ourselves."""
        if said.stance is not Stance.PROPOSE or not self._ledger.is_current(said.evidence):
            return False
        if said.evidence == pair.refused or (mine is not None and said.evidence.id() in supported(mine)):
            return False
        if pair.refused is not None and now_s < pair.refused_s + min(2.0**pair.refusals, _LONGEST_DOUBT_S):
            return False
        if mine is None or mine.stance is not Stance.PROPOSE or mine.evidence.id() in supported(said):
            return True
        return _rank_of(said.evidence) > _rank_of(mine.evidence)

    def _is_answered(self, mine: Statement, said: Statement | None) -> bool:
        """Whether they refused what we propose now."""
        if said is None or said.stance not in (Stance.REJECT, Stance.WITHDRAW):
            return False
        return said.evidence.id() == mine.evidence.id()

    def _may_propose(self, peer: Peer) -> bool:
        """The smaller id searches; the larger one only while the smaller is silent, or when it remembers where that was."""
        return self._ledger.robot < peer.robot or peer.presence is Presence.LOST or peer.robot in self._words.remembered

    def _is_recheck_due(self, pair: Pair, peer: Peer, now_s: float) -> bool:
        own = self._ledger.own.version
        assert own is not None
        options = self._ledger.options
        waited_s = now_s - pair.checked.at_s if pair.checked is not None else 0.0
        if pair.failures > 0 and pair.checked is not None:  # once more, to be sure
            return waited_s >= options.reverify_period_s
        if peer.held is None or (own.digest, peer.held.digest) == pair.checked_digests:
            return False
        if pair.is_urgent or pair.checked is None:
            return True
        has_grown = self.area_m2(peer) >= pair.checked.area_m2 * (1.0 + options.reverify_growth)
        return waited_s >= (options.reverify_period_s if has_grown else self._ledger.renew_period_s())

    def _is_due(self, attempt: Attempt | None, area_m2: float, theirs: MapVersion | None, now_s: float) -> bool:
        """Whether there is more map than last time; or any other map at all, after a long while."""
        options, own = self._ledger.options, self._ledger.own.version
        if attempt is None or own is None or theirs is None:
            return attempt is None
        waited_s = now_s - attempt.at_s
        if waited_s >= options.retry_change_s and (own.digest, theirs.digest) != attempt.digests:
            return True
        return waited_s >= options.retry_period_s and area_m2 >= attempt.area_m2 * (1.0 + options.retry_growth)

    def area_m2(self, peer: Peer) -> float:
        """Map there is to compare: ours, and theirs as held here."""
        return self._ledger.own.known_area_m2 + peer.area_m2


def common_length_m(ours: FeatureMap, theirs: FeatureMap) -> float:
    """Length of our longest lines for which they have one of nearly the same length: rough, and enough to sort by."""
    mine, yours = (np.sort(features.lines[:, _LENGTH_COLUMN])[::-1][:40] for features in (ours, theirs))
    if not len(mine) or not len(yours):
        return 0.0
    nearest = np.abs(mine[:, None] / yours[None, :] - 1.0).min(axis=1)
    return float(mine[nearest < 0.05].sum())


def _rank_of(evidence: Evidence) -> tuple[float, int, bytes]:
    """Which of two proposals for one pair is followed: better, then newer, then any fixed order."""
    newness = evidence.map_a.revision + evidence.map_b.revision
    return (evidence.agree * evidence.match_factor, newness, evidence.id())
