"""What follows from a comparison: a proposal, an assent, a refusal, a renewal or a withdrawal."""

from __future__ import annotations

from agent.fleet.consistency import agreement
from agent.fleet.evidence import evidence_of
from agent.fleet.ledger import Ledger, pair_key
from agent.fleet.pair import Attempt, Pair, Purpose, Running
from agent.fleet.pair_words import PairWords
from agent.fleet.peer import Peer
from agent.merging.result import MatchStatus, MergeResult
from protocol.geometry import wrap_angle
from protocol.messages import NO_DIGEST, Evidence, Stance

_NEWS_M, _NEWS_RAD = 0.04, 0.005  # an edge that moved by as much, about a cell, is told to everybody
_PLAINLY_LOWER = 0.03  # a match factor as far below the gate ends an edge at once; nearer to it one more check decides


class PairVerdicts:
    """Turns results into statements."""

    def __init__(self, ledger: Ledger, words: PairWords) -> None:
        self._ledger, self._words = ledger, words

    def conclude(self, pair: Pair, peer: Peer, running: Running, result: MergeResult, now_s: float) -> None:
        """Take one result in."""
        pair.match_factor, pair.reason = result.factor.value, result.reason
        attempt = Attempt(now_s, running.area_m2, (running.ours.digest, running.theirs.digest))
        match running.purpose:
            case Purpose.COARSE:
                self._on_coarse(pair, running, result, attempt)
            case Purpose.SEARCH | Purpose.HINT | Purpose.LOOP:
                self._on_found(pair, running, result, attempt)
            case Purpose.PROPOSAL:
                self._on_proposal_checked(pair, peer, running, result, now_s)
            case Purpose.RECHECK:
                self._on_rechecked(pair, peer, running, result, now_s)

    def _on_coarse(self, pair: Pair, running: Running, result: MergeResult, attempt: Attempt) -> None:
        pair.coarse, pair.coarse_map = attempt, running.theirs
        is_hopeful = result.status is not MatchStatus.NO or result.score >= self._ledger.options.coarse_hopeful_score
        pair.coarse_misses = 0 if is_hopeful else pair.coarse_misses + 1
        pair.phase = "hopeful" if is_hopeful else "coarse"

    def _on_found(self, pair: Pair, running: Running, result: MergeResult, attempt: Attempt) -> None:
        if running.purpose is Purpose.HINT:
            self._words.forget_hint(pair.peer)  # once: if it does not hold, the search starts afresh
        elif running.purpose is Purpose.LOOP:
            pair.loop = attempt
        if running.purpose is Purpose.SEARCH or result.accepted:
            pair.search = attempt
        pair.phase = result.status.value
        evidence = evidence_of(self._ledger.robot, running, result)
        if result.accepted and evidence is not None:
            pair.phase = "proposed"
            self._words.say(pair.peer, Stance.PROPOSE, evidence, NO_DIGEST, result.reason)

    def _on_proposal_checked(self, pair: Pair, peer: Peer, running: Running, result: MergeResult, now_s: float) -> None:
        evidence = running.evidence
        assert evidence is not None and running.job.T_ours_theirs is not None
        live = self._ledger.live.get(pair_key(self._ledger.robot, pair.peer))
        holds = live.id() if live is not None else NO_DIGEST
        if result.accepted and self._ledger.is_same(result.T_ours_theirs, running.job.T_ours_theirs):
            pair.refused, pair.refusals = None, 0
            self._found_good(pair, peer, running, result, now_s)
            self._words.say(pair.peer, Stance.ACK, evidence, holds, result.reason)
            return
        pair.refused, pair.refusals, pair.refused_s = evidence, pair.refusals + 1, now_s
        pair.phase = "no"
        self._words.say(pair.peer, Stance.REJECT, evidence, holds, result.reason)

    def _on_rechecked(self, pair: Pair, peer: Peer, running: Running, result: MergeResult, now_s: float) -> None:
        live = self._ledger.live.get(pair_key(self._ledger.robot, pair.peer))
        if live is None or running.evidence is None or live.id() != running.evidence.id():
            return
        assert running.job.T_ours_theirs is not None
        if result.status is not MatchStatus.NO:
            self._found_good(pair, peer, running, result, now_s)
            if result.accepted and self._ledger.robot < pair.peer and self._is_news(pair, live, running, result, now_s):
                evidence = evidence_of(self._ledger.robot, running, result)
                if evidence is not None:
                    pair.renewed_s = now_s
                    self._words.say(pair.peer, Stance.PROPOSE, evidence, live.id(), result.reason)
            return
        pair.failures += 1
        pair.checked = Attempt(now_s, running.area_m2)
        pair.checked_digests = (running.ours.digest, running.theirs.digest)
        is_plain = result.factor.value < self._ledger.options.min_match_factor - _PLAINLY_LOWER
        if is_plain or pair.failures >= 2:
            was_urgent = pair.is_urgent
            self._words.withdraw(pair.peer, result.reason, now_s)
            if was_urgent:
                self._words.strike(peer, "map turned false", now_s)

    def _found_good(self, pair: Pair, peer: Peer, running: Running, result: MergeResult, now_s: float) -> None:
        """The transform holds on these very maps: they may enter the global map."""
        pair.failures, pair.is_urgent, pair.phase = 0, False, "merged"
        self._words.forget_hint(pair.peer)
        pair.checked = Attempt(now_s, running.area_m2)
        pair.checked_digests = (running.ours.digest, running.theirs.digest)
        T = result.T_ours_theirs
        if (
            running.job.T_ours_theirs is not None
            and T is not None
            and (pair.conflict_share < 0.0 or running.purpose is Purpose.PROPOSAL)
        ):
            share = agreement(running.job.ours, running.job.theirs, T).wall_conflict_share
            pair.conflict_share = share if pair.conflict_share < 0.0 else min(share, pair.conflict_share)

    def _is_news(self, pair: Pair, live: Evidence, running: Running, result: MergeResult, now_s: float) -> bool:
        """Whether the edge is worth proposing anew with better figures."""
        T, T_old = result.T_ours_theirs, running.job.T_ours_theirs
        assert T is not None and T_old is not None
        has_moved = T.distance_m(T_old) > _NEWS_M or abs(wrap_angle(T.theta_rad - T_old.theta_rad)) > _NEWS_RAD
        cited = {live.map_a.digest, live.map_b.digest}
        is_old = cited != {running.ours.digest, running.theirs.digest} and now_s - pair.renewed_s >= self._ledger.renew_period_s()
        return has_moved or is_old or result.overlap_m2 > live.overlap_m2 * (1.0 + self._ledger.options.renew_growth)
