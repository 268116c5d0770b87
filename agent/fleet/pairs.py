"""What becomes of each pair: seen, compared, proposed, verified, live, withdrawn.

The smaller id searches and proposes; the other side verifies on its own grid and says so about the very same evidence.
An edge lives only while both stand by it.  A pair that does not fit is tried again when a map has grown, not when a clock
has ticked.  While an edge lives, both sides go on checking it as their maps grow.

    other:     announcement        coarse map        cells                      statement
    owner:  feat ──► wants coarse ──► COARSE ──► wants fine ──► SEARCH ──► PROPOSE ──► VERIFY there ──► ACK: live

    PairChoice: what is compared next ──► here: the one comparison under way ──► PairVerdicts ──► PairWords: what we say
"""

from __future__ import annotations

from agent.fleet.effects import Match, MatchKind
from agent.fleet.evidence import facts_of
from agent.fleet.ledger import Ledger
from agent.fleet.pair import Due, Pair, Purpose, Running
from agent.fleet.pair_choice import PairChoice
from agent.fleet.pair_verdicts import PairVerdicts
from agent.fleet.pair_words import PairWords
from agent.fleet.peer import Peer
from agent.merging.result import MergeResult


class PairWork:
    """All pairs of one robot, and the one comparison that runs at a time."""

    def __init__(self, ledger: Ledger) -> None:
        self._ledger = ledger
        self.words = PairWords(ledger)
        self._choice = PairChoice(ledger, self.words)
        self._verdicts = PairVerdicts(ledger, self.words)
        self._running: Running | None = None

    @property
    def pairs(self) -> dict[str, Pair]:
        return self.words.pairs

    def next_job(self, peers: list[Peer], now_s: float) -> None:
        """Update what each pair waits for; start the most urgent comparison when none runs."""
        chosen = self._choice.next(peers, now_s)
        timeout_s = 3.0 * self._ledger.options.fetch_timeout_s
        is_busy = self._running is not None and now_s - self._running.since_s < timeout_s
        if chosen is not None and not is_busy:
            self._start(*chosen, now_s)

    def on_done(self, job: Match, result: MergeResult | None, now_s: float) -> None:
        """The comparison is over; None: it was dropped."""
        running = self._running
        if running is None or running.job.id != job.id:
            return
        self._running = None
        peer = self._ledger.peers.get(job.peer)
        if result is None or peer is None or not self._ledger.is_trusted(job.peer, now_s):
            return
        if not self._is_of_today(running, peer):
            return
        self._ledger.note("merge-attempt", **facts_of(running, result))
        self._verdicts.conclude(self.words.pair(job.peer), peer, running, result, now_s)

    def on_new_frame(self, robot: str, now_s: float) -> None:
        """A robot began its map anew: what was said about the old one is void."""
        self.words.drop_void(robot)
        self._ledger.judge_all(robot, now_s)

    def _is_of_today(self, running: Running, peer: Peer) -> bool:
        """Whether both maps are still drawn in the frames that were compared."""
        ours, theirs = self._ledger.own.version, peer.map
        if ours is None or theirs is None:
            return False
        return (ours.frame, theirs.frame) == (running.ours.frame, running.theirs.frame)

    def _start(self, peer: Peer, due: Due, now_s: float) -> None:
        ledger, own, purpose = self._ledger, self._ledger.own, due.purpose
        pair = self.words.pair(peer.robot)
        assert own.version is not None and own.grid is not None
        ours, theirs_version = own.grid, peer.held
        theirs = peer.grid
        area_m2 = self._choice.area_m2(peer)
        if purpose is Purpose.COARSE:
            coarse = own.coarse()
            assert coarse is not None and peer.coarse is not None
            ours, theirs, theirs_version = coarse.grid, peer.coarse.grid, peer.coarse.map
            area_m2 = own.known_area_m2 + peer.known_area_m2
        assert theirs is not None and theirs_version is not None
        kind = MatchKind(purpose.value) if purpose in (Purpose.COARSE, Purpose.SEARCH) else MatchKind.VERIFY
        job = Match(ledger.new_id(), kind, peer.robot, ours, theirs, own.version.digest, theirs_version.digest, due.T_ours_theirs)
        self._running = Running(job, purpose, own.version, theirs_version, due.evidence, area_m2, now_s)
        pair.attempts += 1
        pair.phase = "verifying" if purpose is Purpose.PROPOSAL else "searching" if pair.phase != "merged" else "merged"
        ledger.effects.append(job)
