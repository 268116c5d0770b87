"""The fleet logic of one robot: messages, results and time in; effects out.  No clock, no thread, no socket.

Every method takes `now_s` (any monotonic clock) and returns the effects that follow.  All calls must take turns.

    message ──► Inbox: is it from this life, is it newer, is it true? ──► Ledger: which edges live now? ──► layout
    tick    ──► OwnWords: beat, announcement
            ──► Pulling ──► Admission ──► PairWork: which comparison next? ──► Composition: which global map?
    query   ──► Registers
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Protocol

from agent.fleet.admission import Admission
from agent.fleet.composition import Composition, Fused
from agent.fleet.effects import Effect, Fetch, Fuse, Match, Send
from agent.fleet.estates import Estates
from agent.fleet.fetching import Fetching
from agent.fleet.inbox import Inbox
from agent.fleet.ledger import Ledger
from agent.fleet.letting_go import LettingGo
from agent.fleet.memory import FleetMemory
from agent.fleet.options import FleetOptions
from agent.fleet.overview import Overview
from agent.fleet.own_words import OwnWords
from agent.fleet.pairs import PairWork
from agent.fleet.peer import Peer
from agent.fleet.pulling import Pulling
from agent.fleet.registers import Registers
from agent.fleet.state import FleetState
from agent.fleet.twins import TwinWatch
from agent.merging.result import MergeResult
from protocol.features import FeatureMap
from protocol.geometry import SE2
from protocol.grid import OccupancyGrid
from protocol.messages import Message

_SCAN_PERIOD_S = 0.2
_SCANNED_PEERS = 64  # a step looks at this many peers; larger fleets take turns


class LocalMap(Protocol):
    """What is used of `agent.mapping.MapEstimate`."""

    @property
    def grid(self) -> OccupancyGrid: ...
    @property
    def T_map_robot(self) -> SE2: ...
    @property
    def epoch(self) -> int: ...


class Coordinator:
    """Finds out with whom our map fits, and keeps the one global map of the group."""

    def __init__(self, robot: str, boot_id: int, options: FleetOptions | None = None) -> None:
        """`boot_id`: 64 bits, new at every start of the process."""
        self.options = options or FleetOptions()
        self.robot, self.boot = robot, boot_id
        self._ledger = ledger = Ledger(robot, boot_id, self.options)
        self._pairs = pairs = PairWork(ledger)
        self._composition = composition = Composition(ledger)
        self._fetching = fetching = Fetching(ledger)
        estates = Estates(ledger)
        self._inbox = Inbox(ledger, pairs, composition, estates, fetching)
        self._admission = Admission(ledger, pairs)
        self._pulling = Pulling(ledger, pairs, composition, estates, fetching)
        self._words = OwnWords(ledger, pairs, composition)
        self._letting_go = LettingGo(ledger, pairs.words, composition)
        self._twins = TwinWatch(ledger)
        self._registers = Registers(ledger, self._words, composition, estates)
        self._overview = Overview(ledger, pairs, composition)
        self._scan_from = 0

    @property
    def is_twin(self) -> bool:
        """Whether another, older process uses our name: nothing is published."""
        return self._twins.is_twin

    @property
    def counts(self) -> dict[str, int]:
        return self._ledger.counts

    # What comes in.

    def on_local_map(self, estimate: LocalMap, features: FeatureMap, now_s: float) -> Sequence[Effect]:
        """Our own map changed; call as often as you like (at most every `announce_period_s` is announced)."""
        now_s = self._ledger.clock.at(now_s)
        self._words.T_map_robot = estimate.T_map_robot
        self._words.take_map(estimate.grid, features, estimate.epoch, now_s)
        return self._done()

    def on_pose(self, T_map_robot: SE2, now_s: float) -> None:
        """Where we are in our own map; travels with the next beat."""
        self._words.T_map_robot = T_map_robot

    def on_message(self, message: Message, now_s: float) -> Sequence[Effect]:
        """A peer said something: already decoded, its `robot` already checked against the key it came on."""
        now_s = self._ledger.clock.at(now_s)
        if message.robot == self.robot:
            self._twins.on_own_name(message, now_s)
        else:
            self._inbox.hear(message, now_s)
        return self._done()

    def on_garbage(self, robot: str, reason: str, now_s: float) -> Sequence[Effect]:
        """Bytes came on a key of this robot that no honest robot sends (they did not decode, or named somebody else)."""
        now_s = self._ledger.clock.at(now_s)
        self._ledger.count("garbage")
        peer = self._ledger.peers.get(robot)
        if peer is not None:
            self._pairs.words.strike(peer, "garbage", now_s)
        return self._done()

    def on_fetched(self, fetch: Fetch, message: Message | None, now_s: float) -> Sequence[Effect]:
        """The answer to a `Fetch`; None: nobody answered, or not with what was promised."""
        now_s = self._ledger.clock.at(now_s)
        peer = self._ledger.peers.get(fetch.peer)
        is_from_it = peer is not None and message is not None and (message.robot, message.boot) == (peer.robot, peer.boot)
        subject = self._fetching.done(fetch, is_from_it, now_s)
        if subject is None or peer is None or message is None or not is_from_it or peer.trust.is_quarantined(now_s):
            return self._done()
        self._inbox.take(peer, message, now_s)
        self._ledger.timetable.next_scan_s = now_s
        return self._done()

    def on_match_done(self, job: Match, result: MergeResult | None, now_s: float) -> Sequence[Effect]:
        """The `MergeResult` of a `Match`; None: the job was dropped."""
        now_s = self._ledger.clock.at(now_s)
        self._pairs.on_done(job, result, now_s)
        self._ledger.judge_pair(self.robot, job.peer, now_s)
        self._ledger.timetable.next_scan_s = now_s
        return self._done()

    def on_fused(self, job: Fuse, fused: Fused | None, now_s: float) -> Sequence[Effect]:
        """The `FusedMap` of a `Fuse`; None: the job was dropped."""
        now_s = self._ledger.clock.at(now_s)
        self._composition.on_fused(job, fused, now_s)
        return self._done()

    # What happens by itself.

    def tick(self, now_s: float) -> Sequence[Effect]:
        """Call about ten times a second: beats, retries, presence."""
        now_s = self._ledger.clock.at(now_s)
        self._twins.check(now_s)
        self._words.announce(now_s)
        if now_s >= self._ledger.timetable.next_beat_s:
            self._words.beat(now_s)
        if now_s >= self._ledger.timetable.next_scan_s:
            self._ledger.timetable.next_scan_s = now_s + _SCAN_PERIOD_S
            self._scan(now_s)
        return self._done()

    def _scan(self, now_s: float) -> None:
        """Who is there; what is missing; whose cells are admitted; what is compared; what is composed."""
        for peer in self._ledger.roster.update_presence(now_s):
            self._ledger.note(f"peer-{peer.presence.value}", peer=peer.robot)
        turn = self._next_peers()
        for peer in turn:
            self._pulling.pull_words(peer, now_s)
            if peer.held is not None and (peer.held != peer.admitted or peer.anchor is None):
                self._admission.admit(peer, now_s)
        self._pairs.next_job(turn, now_s)
        self._pulling.pull_maps(turn, now_s)
        self._letting_go.check(now_s)

    def _next_peers(self) -> list[Peer]:
        """Everybody, in fleets of ordinary size; larger ones take turns."""
        everyone = list(self._ledger.peers.values())
        count = min(_SCANNED_PEERS, len(everyone))
        turn = list(itertools.islice(itertools.cycle(everyone), self._scan_from, self._scan_from + count)) if everyone else []
        self._scan_from = (self._scan_from + count) % max(len(everyone), 1)
        return turn

    # What an operator or a peer asks.

    def unmerge(self, peer: str, now_s: float) -> Sequence[Effect]:
        """The operator takes a peer out of our map, until `readmit`."""
        now_s = self._ledger.clock.at(now_s)
        if peer not in self._ledger.roster.unmerged:
            self._ledger.roster.unmerged.add(peer)
            self._pairs.words.withdraw(peer, "unmerged by the operator", now_s)
            self._ledger.judge_all(peer, now_s)
            self._ledger.note("unmerged", peer=peer)
            self._ledger.timetable.next_scan_s = now_s
        return self._done()

    def readmit(self, peer: str, now_s: float) -> Sequence[Effect]:
        """The operator allows a peer again: ends `unmerge` and quarantine."""
        now_s = self._ledger.clock.at(now_s)
        self._ledger.roster.unmerged.discard(peer)
        known = self._ledger.peers.get(peer)
        if known is not None:
            known.trust.pardon()
            self._pairs.pairs.pop(peer, None)
            self._ledger.judge_all(peer, now_s)
        return self._done()

    def memory(self) -> FleetMemory:
        """What to keep over a restart; see `recall`."""
        ledger = self._ledger
        places = {e.other(self.robot): ledger.from_our_side(e) for key, e in ledger.live.items() if self.robot in key}
        unmerged = tuple(sorted(ledger.roster.unmerged))
        return FleetMemory(self._words.epoch, {**self._pairs.words.remembered, **places}, unmerged)

    def recall(self, memory: FleetMemory) -> None:
        """At the start: verify these transforms before anything is searched for."""
        self._pairs.words.remembered = dict(memory.T_ours_theirs)
        self._words.epoch = self._words.recalled_epoch = memory.epoch
        self._ledger.roster.unmerged = set(memory.unmerged)

    def register(self, key: str) -> bytes | None:
        """The encoded answer to a query on our subtree, at most 16 KB; None: there is no such register."""
        return None if self.is_twin else self._registers.answer(key)

    def peer_maps(self) -> dict[str, tuple[bytes, OccupancyGrid]]:
        """(digest, cells) of the newest map that is here of each peer."""
        peers = self._ledger.peers.values()
        return {peer.robot: (peer.held.digest, peer.grid) for peer in peers if peer.held is not None and peer.grid is not None}

    def state(self, now_s: float) -> FleetState:
        """The fleet as we see it."""
        return self._overview.state(self._ledger.clock.at(now_s), self._words.T_map_robot, is_twin=self.is_twin)

    def _done(self) -> list[Effect]:
        effects, self._ledger.effects = self._ledger.effects, []
        if self.is_twin:
            return [effect for effect in effects if not isinstance(effect, Send)]
        return effects
