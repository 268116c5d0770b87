"""What becomes of each pair: seen, compared, proposed, verified, live, withdrawn.

The smaller id searches and proposes; the other side verifies on its own grid and says so about the very same evidence.
An edge lives only while both stand by it.  A pair that does not fit is tried again when a map has grown, not when a clock
has ticked.  While an edge lives, both sides go on checking it as their maps grow.

    other:     announcement        coarse map        cells                      statement
    owner:  feat ──► wants coarse ──► COARSE ──► wants fine ──► SEARCH ──► PROPOSE ──► VERIFY there ──► ACK: live
"""

from __future__ import annotations

import enum
from dataclasses import dataclass

import numpy as np

from agent.fleet.consistency import agreement
from agent.fleet.effects import Match, MatchKind
from agent.fleet.ledger import Ledger, pair_key, supported
from agent.fleet.members import Peer
from agent.fleet.state import Presence
from agent.merging.result import MatchStatus, MergeResult, inverse_covariance
from protocol.features import LINE_COLUMNS, FeatureMap
from protocol.geometry import SE2, wrap_angle
from protocol.messages import NO_DIGEST, Evidence, MapVersion, Stance, Statement, Symmetric3


class Purpose(enum.Enum):
    """Why a comparison is made."""

    COARSE = "coarse"
    SEARCH = "search"
    HINT = "hint"  # a transform that held before a map was redrawn
    LOOP = "loop"  # the frames of our group predict a transform for a pair without an edge
    PROPOSAL = "proposal"  # the other side says so
    RECHECK = "recheck"  # an edge lives; does it still?


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


@dataclass(slots=True)
class Attempt:
    """When a comparison was made last, and on how much map."""

    at_s: float
    area_m2: float
    digests: tuple[bytes, bytes] = (b"", b"")  # of ours and theirs


@dataclass(slots=True)
class Pair:
    """Our side of one pair."""

    peer: str
    boot: int = 0  # of the peer, when we spoke about the pair last
    phase: str = "unseen"
    reason: str = ""
    attempts: int = 0
    match_factor: float = 0.0
    coarse: Attempt | None = None
    coarse_map: MapVersion | None = None  # of theirs, compared last
    coarse_misses: int = 0
    search: Attempt | None = None
    loop: Attempt | None = None
    checked: Attempt | None = None
    checked_digests: tuple[bytes, bytes] = (b"", b"")
    conflict_share: float = -1.0  # of the walls, when the edge was first found good; negative: not yet
    failures: int = 0  # checks of the live edge that failed, in a row
    is_urgent: bool = False  # the newest cells contradict the edge
    renewed_s: float = -1e18
    hint: SE2 | None = None  # T_ours_theirs that held before a frame was drawn anew
    refused: Evidence | None = None  # evidence of theirs that we checked and did not find true
    refusals: int = 0  # in a row
    refused_s: float = 0.0
    promise: float = 0.0  # how alike the features are: whom to look at first
    promise_of: tuple[int, int] = (-1, -1)  # frames and revisions it was computed from
    is_courted: bool = False  # its maps may be pulled
    wants_coarse: bool = False
    wants_fine: bool = False


@dataclass(frozen=True, slots=True)
class _Running:
    job: Match
    purpose: Purpose
    ours: MapVersion
    theirs: MapVersion
    evidence: Evidence | None
    area_m2: float
    since_s: float


class PairWork:
    """All pairs of one robot, and the one comparison that runs at a time."""

    def __init__(self, ledger: Ledger) -> None:
        self._ledger = ledger
        self.pairs: dict[str, Pair] = {}
        self._running: _Running | None = None
        self._tokens, self._tokens_s = float(ledger.options.strangers_at_once), 0.0

    def pair(self, peer: str) -> Pair:
        return self.pairs.setdefault(peer, Pair(peer))

    # What to do next.

    def next_job(self, peers: list[Peer], now_s: float) -> None:
        """Update what each pair waits for; start the most urgent comparison when none runs."""
        self._refill(now_s)
        ordered = sorted(peers, key=lambda peer: -self._promise(peer))
        options = [option for peer in ordered if (option := self._option(peer, now_s)) is not None]
        timeout_s = 3.0 * self._ledger.options.fetch_timeout_s
        if self._running is not None and now_s - self._running.since_s < timeout_s:
            return
        if options:
            _, _, peer, purpose, evidence, T = min(options, key=lambda option: option[:2])
            self._start(peer, purpose, evidence, T, now_s)

    def _option(
        self, peer: Peer, now_s: float
    ) -> tuple[tuple[int, float], str, Peer, Purpose, Evidence | None, SE2 | None] | None:
        """What could be compared with this peer now; notes what has to be pulled for it."""
        pair = self.pair(peer.robot)
        pair.wants_coarse = pair.wants_fine = False
        ledger = self._ledger
        if ledger.own.version is None or peer.map is None or not ledger.is_trusted(peer.robot, now_s):
            return None
        found = self._due(pair, peer, now_s)
        if found is None:
            return None
        purpose, evidence, T = found
        attempt = pair.search or pair.coarse
        return (_URGENCY[purpose], attempt.at_s if attempt else 0.0), peer.robot, peer, purpose, evidence, T

    def _due(self, pair: Pair, peer: Peer, now_s: float) -> tuple[Purpose, Evidence | None, SE2 | None] | None:
        ledger = self._ledger
        said = peer.statements.get(ledger.robot)
        mine = ledger.mine.get(peer.robot)
        if said is not None and self._must_verify(pair, said, mine, now_s):
            theirs = said.evidence.map_a if peer.robot == said.evidence.robot_a else said.evidence.map_b
            if not _holds(peer, theirs):
                pair.wants_fine = True
                return None
            return Purpose.PROPOSAL, said.evidence, self._from_our_side(said.evidence)
        live = ledger.live.get(pair_key(ledger.robot, peer.robot))
        if live is not None:
            if _is_in_frame(peer) and self._is_recheck_due(pair, peer, now_s):
                return Purpose.RECHECK, live, self._from_our_side(live)
            return None
        if mine is not None and mine.stance is Stance.PROPOSE and not self._is_answered(mine, said):
            return None  # the other side has not spoken yet
        if not self._may_propose(peer):
            return None
        group = ledger.group
        if group is not None and peer.robot in group.T_root:
            return self._loop(pair, peer, now_s)
        return self._approach(pair, peer, now_s)

    def _loop(self, pair: Pair, peer: Peer, now_s: float) -> tuple[Purpose, Evidence | None, SE2 | None] | None:
        """A pair of our own group without an edge: one more edge makes one more loop to check the others by."""
        group = self._ledger.group
        assert group is not None
        edges = sum(self._ledger.robot in key for key in self._ledger.live)
        if not _is_in_frame(peer) or edges >= self._ledger.options.max_edges:
            return None
        if not self._is_due(pair.loop, self._area_m2(peer), peer.held, now_s):
            return None
        return Purpose.LOOP, None, group.T_root[self._ledger.robot].inverse() @ group.T_root[peer.robot]

    def _approach(self, pair: Pair, peer: Peer, now_s: float) -> tuple[Purpose, Evidence | None, SE2 | None] | None:
        """A stranger: the coarse map first, the cells when that looks hopeful, then the search."""
        options = self._ledger.options
        if _is_in_frame(peer):
            if not self._is_due(pair.search, self._ledger.own.known_area_m2 + peer.known_area_m2, peer.map, now_s):
                return None
            if peer.held != peer.map:
                pair.wants_fine = True  # grown since: search on the newest
                if not self._is_due(pair.search, self._area_m2(peer), peer.held, now_s):
                    return None
            return (Purpose.HINT, None, pair.hint) if pair.hint else (Purpose.SEARCH, None, None)
        announced = peer.announcement
        if announced is None or not self._may_court(pair):
            return None
        if announced.fine_bytes <= options.coarse_skip_bytes or pair.phase == "hopeful" or pair.coarse_misses >= 3:
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
        return Purpose.COARSE, None, None

    def _may_court(self, pair: Pair) -> bool:
        """Strangers are looked at a few a minute: in a fleet of a thousand nobody can look at everybody at once."""
        if not pair.is_courted and self._tokens >= 1.0:
            self._tokens -= 1.0
            pair.is_courted = True
        return pair.is_courted

    def _refill(self, now_s: float) -> None:
        options = self._ledger.options
        gained = (now_s - self._tokens_s) / 60.0 * options.strangers_per_minute
        self._tokens, self._tokens_s = min(self._tokens + gained, float(options.strangers_at_once)), now_s

    def _promise(self, peer: Peer) -> float:
        """How much wall of our features has a like in theirs; strangers that promise most come first."""
        ours, theirs = self._ledger.own.announcement, peer.announcement
        if ours is None or theirs is None:
            return 0.0
        pair, of = self.pair(peer.robot), (ours.map.revision, theirs.map.revision)
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
        return _rank(said.evidence) > _rank(mine.evidence)

    def _is_answered(self, mine: Statement, said: Statement | None) -> bool:
        """Whether they refused what we propose now."""
        if said is None or said.stance not in (Stance.REJECT, Stance.WITHDRAW):
            return False
        return said.evidence.id() == mine.evidence.id()

    def _may_propose(self, peer: Peer) -> bool:
        """The smaller id searches; the larger one only while the smaller is silent."""
        return self._ledger.robot < peer.robot or peer.presence is Presence.LOST

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
        has_grown = self._area_m2(peer) >= pair.checked.area_m2 * (1.0 + options.reverify_growth)
        return waited_s >= (options.reverify_period_s if has_grown else self._renew_period_s())

    def _is_due(self, attempt: Attempt | None, area_m2: float, theirs: MapVersion | None, now_s: float) -> bool:
        """Whether there is more map than last time; or any other map at all, after a long while."""
        options, own = self._ledger.options, self._ledger.own.version
        if attempt is None or own is None or theirs is None:
            return attempt is None
        waited_s = now_s - attempt.at_s
        if waited_s >= options.retry_change_s and (own.digest, theirs.digest) != attempt.digests:
            return True
        return waited_s >= options.retry_period_s and area_m2 >= attempt.area_m2 * (1.0 + options.retry_growth)

    def _area_m2(self, peer: Peer) -> float:
        """Map there is to compare: ours, and theirs as held here."""
        return self._ledger.own.known_area_m2 + peer.area_m2

    def _start(self, peer: Peer, purpose: Purpose, evidence: Evidence | None, T: SE2 | None, now_s: float) -> None:
        ledger, own = self._ledger, self._ledger.own
        pair = self.pair(peer.robot)
        assert own.version is not None and own.grid is not None
        ours, theirs_version = own.grid, peer.held
        theirs = peer.grid
        area_m2 = self._area_m2(peer)
        if purpose is Purpose.COARSE:
            coarse = own.coarse()
            assert coarse is not None and peer.coarse is not None
            ours, theirs, theirs_version = coarse.grid, peer.coarse.grid, peer.coarse.map
            area_m2 = own.known_area_m2 + peer.known_area_m2
        assert theirs is not None and theirs_version is not None
        kind = MatchKind(purpose.value) if purpose in (Purpose.COARSE, Purpose.SEARCH) else MatchKind.VERIFY
        job = Match(ledger.new_id(), kind, peer.robot, ours, theirs, own.version.digest, theirs_version.digest, T)
        self._running = _Running(job, purpose, own.version, theirs_version, evidence, area_m2, now_s)
        pair.attempts += 1
        pair.phase = "verifying" if purpose is Purpose.PROPOSAL else "searching" if pair.phase != "merged" else "merged"
        ledger.effects.append(job)

    # What came of it.

    def on_done(self, job: Match, result: MergeResult | None, now_s: float) -> None:
        running = self._running
        if running is None or running.job.id != job.id:
            return
        self._running = None
        peer = self._ledger.peers.get(job.peer)
        if result is None or peer is None or not self._ledger.is_trusted(job.peer, now_s):
            return
        ours, theirs = self._ledger.own.version, peer.map
        if ours is None or theirs is None or (ours.frame, theirs.frame) != (running.ours.frame, running.theirs.frame):
            return  # a map was begun anew meanwhile
        pair = self.pair(job.peer)
        pair.match_factor, pair.reason = result.factor.value, result.reason
        self._note_attempt(running, result)
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

    def _on_coarse(self, pair: Pair, running: _Running, result: MergeResult, attempt: Attempt) -> None:
        pair.coarse, pair.coarse_map = attempt, running.theirs
        is_hopeful = result.status is not MatchStatus.NO or result.score >= self._ledger.options.coarse_hopeful_score
        pair.coarse_misses = 0 if is_hopeful else pair.coarse_misses + 1
        pair.phase = "hopeful" if is_hopeful else "coarse"

    def _on_found(self, pair: Pair, running: _Running, result: MergeResult, attempt: Attempt) -> None:
        if running.purpose is Purpose.HINT:
            pair.hint = None  # once: if it does not hold, the search starts afresh
        elif running.purpose is Purpose.LOOP:
            pair.loop = attempt
        if running.purpose is Purpose.SEARCH or result.accepted:
            pair.search = attempt
        pair.phase = result.status.value
        evidence = self._evidence(running, result)
        if result.accepted and evidence is not None:
            pair.phase = "proposed"
            self.say(pair.peer, Stance.PROPOSE, evidence, NO_DIGEST, result.reason)

    def _on_proposal_checked(self, pair: Pair, peer: Peer, running: _Running, result: MergeResult, now_s: float) -> None:
        evidence = running.evidence
        assert evidence is not None and running.job.T_ours_theirs is not None
        live = self._ledger.live.get(pair_key(self._ledger.robot, pair.peer))
        holds = live.id() if live is not None else NO_DIGEST
        if result.accepted and self._is_same(result.T_ours_theirs, running.job.T_ours_theirs):
            pair.refused, pair.refusals = None, 0
            self._found_good(pair, peer, running, result, now_s)
            self.say(pair.peer, Stance.ACK, evidence, holds, result.reason)
            return
        pair.refused, pair.refusals, pair.refused_s = evidence, pair.refusals + 1, now_s
        pair.phase = "no"
        self.say(pair.peer, Stance.REJECT, evidence, holds, result.reason)

    def _on_rechecked(self, pair: Pair, peer: Peer, running: _Running, result: MergeResult, now_s: float) -> None:
        live = self._ledger.live.get(pair_key(self._ledger.robot, pair.peer))
        if live is None or running.evidence is None or live.id() != running.evidence.id():
            return
        assert running.job.T_ours_theirs is not None
        if result.status is not MatchStatus.NO:
            self._found_good(pair, peer, running, result, now_s)
            if result.accepted and self._ledger.robot < pair.peer and self._is_news(pair, live, running, result, now_s):
                evidence = self._evidence(running, result)
                if evidence is not None:
                    pair.renewed_s = now_s
                    self.say(pair.peer, Stance.PROPOSE, evidence, live.id(), result.reason)
            return
        pair.failures += 1
        pair.checked = Attempt(now_s, running.area_m2)
        pair.checked_digests = (running.ours.digest, running.theirs.digest)
        is_plain = result.factor.value < self._ledger.options.min_match_factor - 0.03
        if is_plain or pair.failures >= 2:
            was_urgent = pair.is_urgent
            self.withdraw(pair.peer, result.reason, now_s)
            if was_urgent:
                self.strike(peer, "map turned false", now_s)

    def _found_good(self, pair: Pair, peer: Peer, running: _Running, result: MergeResult, now_s: float) -> None:
        """The transform holds on these very maps: they may enter the global map."""
        pair.failures, pair.is_urgent, pair.phase, pair.hint = 0, False, "merged", None
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

    def _renew_period_s(self) -> float:
        """Everybody hears every renewal, so large fleets renew less often."""
        options = self._ledger.options
        return options.renew_period_s * max(1.0, len(self._ledger.peers) / options.max_beats_per_s)

    def _is_news(self, pair: Pair, live: Evidence, running: _Running, result: MergeResult, now_s: float) -> bool:
        """Whether the edge is worth proposing anew with better figures."""
        T, T_old = result.T_ours_theirs, running.job.T_ours_theirs
        assert T is not None and T_old is not None
        has_moved = T.distance_m(T_old) > 0.04 or abs(wrap_angle(T.theta_rad - T_old.theta_rad)) > 0.005
        cited = {live.map_a.digest, live.map_b.digest}
        is_old = cited != {running.ours.digest, running.theirs.digest} and now_s - pair.renewed_s >= self._renew_period_s()
        return has_moved or is_old or result.overlap_m2 > live.overlap_m2 * (1.0 + self._ledger.options.renew_growth)

    def _is_same(self, T: SE2 | None, other: SE2) -> bool:
        options = self._ledger.options
        if T is None:
            return False
        turn_rad = abs(wrap_angle(T.theta_rad - other.theta_rad))
        return T.distance_m(other) < options.same_transform_m and turn_rad < options.same_transform_rad

    # What we say.

    def say(self, other: str, stance: Stance, evidence: Evidence, holds: bytes, reason: str) -> None:
        """Change our statement about a pair, and publish it."""
        ledger = self._ledger
        ledger.seq += 1
        holds = NO_DIGEST if holds == evidence.id() else holds
        readable = "".join(c for c in reason if c.isprintable())[:80]
        statement = Statement(ledger.robot, ledger.boot, ledger.seq, other, stance, evidence, holds, readable)
        ledger.mine[other] = statement
        self.pair(other).boot = ledger.peers[other].boot
        ledger.send(statement)

    def withdraw(self, other: str, reason: str, now_s: float) -> None:
        """What we said about this pair no longer holds."""
        mine = self._ledger.mine.get(other)
        if mine is None or mine.stance is Stance.WITHDRAW:
            return
        pair = self.pair(other)
        pair.phase, pair.reason, pair.failures, pair.is_urgent = "withdrawn", reason, 0, False
        peer = self._ledger.peers.get(other)
        area_m2 = self._ledger.own.known_area_m2 + (peer.known_area_m2 if peer else 0.0)
        pair.search = pair.loop = Attempt(now_s, area_m2)
        self.say(other, Stance.WITHDRAW, mine.evidence, NO_DIGEST, reason)
        self._ledger.note("withdrawn", peer=other, reason=reason)

    def on_proposal(self, peer: Peer, said: Statement, now_s: float) -> None:
        """An honest robot does not propose one transform, and then quite another, on the very same maps."""
        before = peer.statements.get(self._ledger.robot)
        if before is None or before.stance is not Stance.PROPOSE or said.stance is not Stance.PROPOSE:
            return
        old, new = before.evidence, said.evidence
        if (old.map_a, old.map_b) == (new.map_a, new.map_b) and not self._is_same(old.T_a_b, new.T_a_b):
            self.strike(peer, "false proposal", now_s)

    def on_said(self, peer: Peer, now_s: float) -> None:
        """The other side spoke about us: answer a withdrawal, take note of a refusal."""
        said = peer.statements.get(self._ledger.robot)
        mine = self._ledger.mine.get(peer.robot)
        if said is None or mine is None or mine.stance not in (Stance.PROPOSE, Stance.ACK):
            return
        if said.stance in (Stance.WITHDRAW, Stance.REJECT) and not supported(mine) & supported(said):
            is_about_ours = said.evidence.id() in (mine.evidence.id(), mine.holds)
            if is_about_ours:
                self.withdraw(peer.robot, f"{peer.robot}: {said.reason or said.stance.value}", now_s)

    def drop_void(self, robot: str) -> None:
        """Forget everything about frames that are drawn no more; remember where the peer was, in case it is there still."""
        others = [robot] if robot != self._ledger.robot else sorted(self.pairs)
        for other in others:
            if self._ledger.frame_of(other) is None:
                continue
            mine, old = self._ledger.mine.get(other), self.pair(other)
            if mine is not None and self._ledger.is_current(mine.evidence):
                continue
            pair = self.pairs[other] = Pair(other, attempts=old.attempts)
            if mine is None:
                continue
            peer = self._ledger.peers.get(other)
            if mine.stance in (Stance.PROPOSE, Stance.ACK) and peer is not None and peer.boot == old.boot:
                pair.hint = self._from_our_side(mine.evidence)
            del self._ledger.mine[other]
            self._ledger.seq += 1

    def strike(self, peer: Peer, reason: str, now_s: float) -> None:
        """Count an untruth; too many and the peer is no longer heard."""
        options = self._ledger.options
        if peer.trust.strike(reason, options.quarantine_strikes, options.quarantine_s, now_s):
            self._ledger.note("quarantined", is_warning=True, peer=peer.robot, reason=reason)
            self.withdraw(peer.robot, "quarantined", now_s)
            self._ledger.judge_all(peer.robot, now_s)

    # Small things.

    def _from_our_side(self, evidence: Evidence) -> SE2:
        return evidence.T_a_b if self._ledger.robot == evidence.robot_a else evidence.T_a_b.inverse()

    def _evidence(self, running: _Running, result: MergeResult) -> Evidence | None:
        """A result as both sides will speak of it; None when its numbers cannot be trusted."""
        T = result.T_ours_theirs
        if T is None or not T.is_finite() or not np.all(np.isfinite(result.covariance)):
            return None
        us, them = self._ledger.robot, running.job.peer
        covariance = result.covariance
        a, b, map_a, map_b = us, them, running.ours, running.theirs
        if them < us:
            a, b, map_a, map_b = them, us, running.theirs, running.ours
            covariance, T = inverse_covariance(T, covariance), T.inverse()
        T = SE2(float(T.x_m) + 0.0, float(T.y_m) + 0.0, wrap_angle(float(T.theta_rad)) + 0.0)
        factor = result.factor
        overlap_m2, score = float(max(result.overlap_m2, 0.0)), float(np.clip(result.score, -1e9, 1e9))
        figures = (int(factor.agree), int(factor.disagree), overlap_m2, score)
        return Evidence(a, b, map_a, map_b, us, T, _upper(covariance), *figures)

    def _note_attempt(self, running: _Running, result: MergeResult) -> None:
        T = result.T_ours_theirs
        self._ledger.note(
            "merge-attempt",
            peer=running.job.peer,
            purpose=running.purpose.value,
            status=result.status.value,
            reason=result.reason,
            match_factor=result.factor.value,
            overlap_m2=result.overlap_m2,
            score=result.score,
            runner_up=result.runner_up_score,
            ours=running.ours.digest.hex()[:8],
            theirs=running.theirs.digest.hex()[:8],
            T_ours_theirs=None if T is None else (T.x_m, T.y_m, T.theta_rad),
        )


def common_length_m(ours: FeatureMap, theirs: FeatureMap) -> float:
    """Length of our longest lines for which they have one of nearly the same length: rough, and enough to sort by."""
    mine, yours = (np.sort(features.lines[:, _LENGTH_COLUMN])[::-1][:40] for features in (ours, theirs))
    if not len(mine) or not len(yours):
        return 0.0
    nearest = np.abs(mine[:, None] / yours[None, :] - 1.0).min(axis=1)
    return float(mine[nearest < 0.05].sum())


def _is_in_frame(peer: Peer) -> bool:
    """Whether we hold cells of the map the peer draws now."""
    return peer.held is not None and peer.map is not None and peer.held.frame == peer.map.frame


def _holds(peer: Peer, version: MapVersion) -> bool:
    """Whether we hold this version or a later one of the same map."""
    return peer.held is not None and peer.held.frame == version.frame and peer.held.revision >= version.revision


def _rank(evidence: Evidence) -> tuple[float, int, bytes]:
    """Which of two proposals for one pair is followed: better, then newer, then any fixed order."""
    newness = evidence.map_a.revision + evidence.map_b.revision
    return (evidence.agree * evidence.match_factor, newness, evidence.id())


def _upper(covariance: object) -> Symmetric3:
    """The upper triangle, made symmetric and safely positive."""
    full = np.asarray(covariance, np.float64)
    full = 0.5 * (full + full.T)
    values, vectors = np.linalg.eigh(full)
    full = (vectors * np.clip(values, 1e-12, 1e9)) @ vectors.T
    xx, xy, xt, yy, yt, tt = (float(full[i, j]) for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)))
    return xx, xy, xt, yy, yt, tt
