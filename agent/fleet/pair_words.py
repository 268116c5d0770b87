"""What we say about each pair, and how we take what the other side says.

A statement stands until it is replaced.  An edge lives only while both sides stand by the same evidence, so saying less is
always safe: a withdrawal needs nobody's consent.
"""

from __future__ import annotations

from agent.fleet.ledger import Ledger, supported
from agent.fleet.pair import Attempt, Pair
from agent.fleet.peer import Peer
from protocol.geometry import SE2
from protocol.messages import NO_DIGEST, Evidence, Stance, Statement


class PairWords:
    """The table of all pairs, and our statements about them."""

    def __init__(self, ledger: Ledger) -> None:
        self._ledger = ledger
        self.pairs: dict[str, Pair] = {}
        self.remembered: dict[str, SE2] = {}  # T_ours_theirs of a life before: tried once, then forgotten

    def pair(self, peer: str) -> Pair:
        known = self.pairs.get(peer)  # not `setdefault`, which makes a new one at each of thousands of questions a second
        if known is None:
            known = self.pairs[peer] = Pair(peer)
        return known

    def hint(self, peer: str) -> SE2 | None:
        """Where this peer's map lay on ours before one of them was begun or read anew."""
        return self.pair(peer).hint or self.remembered.get(peer)

    def forget_hint(self, peer: str) -> None:
        self.pair(peer).hint = None
        self.remembered.pop(peer, None)

    def forget_hints(self) -> None:
        """Our own map was begun in another place."""
        for pair in self.pairs.values():
            pair.hint = None

    def say(self, other: str, stance: Stance, evidence: Evidence, holds: bytes, reason: str) -> None:
        """Change our statement about a pair, and publish it."""
        ledger = self._ledger
        ledger.seq += 1
        holds = NO_DIGEST if holds == evidence.id() else holds
        readable = "".join(c for c in reason if c.isprintable())[:80]
        statement = Statement(ledger.robot, ledger.boot, ledger.seq, other, stance, evidence, holds, readable)
        ledger.mine[other] = statement
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
        if (old.map_a, old.map_b) == (new.map_a, new.map_b) and not self._ledger.is_same(old.T_a_b, new.T_a_b):
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
            if mine.stance in (Stance.PROPOSE, Stance.ACK):
                pair.hint = self._ledger.from_our_side(mine.evidence)
            del self._ledger.mine[other]
            self._ledger.seq += 1

    def forget(self, robot: str) -> None:
        """A robot that gave way to others: we say nothing of it any more, and compare it anew when it comes back."""
        self.pairs.pop(robot, None)
        if self._ledger.mine.pop(robot, None) is not None:
            self._ledger.seq += 1

    def strike(self, peer: Peer, reason: str, now_s: float) -> None:
        """Count an untruth; too many and the peer is no longer heard."""
        options = self._ledger.options
        if peer.trust.strike(reason, options.quarantine_strikes, options.quarantine_s, now_s):
            self._ledger.note("quarantined", is_warning=True, peer=peer.robot, reason=reason)
            self.withdraw(peer.robot, "quarantined", now_s)
            self._ledger.judge_all(peer.robot, now_s)
