"""The fleet logic of one robot: messages, results and time in; effects out.  No clock, no thread, no socket.

Every method takes `now_s` (any monotonic clock) and returns the effects that follow.  All calls must take turns.

    message ──► Roster: is it from this life, is it newer? ──► Ledger: which edges live now? ──► layout
    tick    ──► beat, presence ──► PairWork: which comparison next? ──► Composition: which global map? ──► Fetching
"""

from __future__ import annotations

import hashlib
import itertools
import random
import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

from agent.fleet.composition import Composition, Fused
from agent.fleet.consistency import agreement
from agent.fleet.effects import Effect, Fetch, Fuse, Match, Send
from agent.fleet.fetching import Fetching
from agent.fleet.ledger import Ledger, pair_key, statements_digest
from agent.fleet.members import Peer, newer_statements
from agent.fleet.options import FleetOptions
from agent.fleet.pairs import PairWork
from agent.fleet.state import FleetState, FrameState, PeerState, Presence
from agent.merging.result import MergeResult
from protocol.channels import MAJOR_VERSION, fine_register, global_register
from protocol.codec import encode
from protocol.errors import RemoteProtocolError
from protocol.features import FeatureMap
from protocol.geometry import SE2
from protocol.grid import OccupancyGrid
from protocol.messages import (
    NO_DIGEST,
    Beat,
    CoarseMap,
    Evidence,
    FineTiles,
    GlobalMeta,
    GlobalTiles,
    Hello,
    MapAnnouncement,
    MapVersion,
    Message,
    Statement,
    Statements,
)

SOFTWARE = "mapquilt"
_SCAN_PERIOD_S = 0.2
_SCANNED_PEERS = 64  # a step looks at this many peers; larger fleets take turns
_HELLO_PERIOD_S = 5.0
_GRACE_S = 0.4  # a beat may overtake the hint it speaks of
_DIGEST = re.compile(r"-|[0-9a-f]{32}")


class LocalMap(Protocol):
    """What is used of `agent.mapping.MapEstimate`."""

    @property
    def grid(self) -> OccupancyGrid: ...
    @property
    def T_map_robot(self) -> SE2: ...
    @property
    def epoch(self) -> int: ...


@dataclass(slots=True)
class _Twin:
    """Another process that uses our name."""

    boot: int
    seq: int = 0
    beats: int = 0
    heard_s: float = -1e9


class _Clock:
    """Time that only flows forward, and never faster than it is watched.

    A clock set back stands still until it has caught up; a process that was stopped for a minute wakes up as if two seconds
    had passed, because the beats of that minute still wait in its inbox and nobody is lost.
    """

    _LONGEST_STEP_S = 2.0

    def __init__(self) -> None:
        self._given_s: float | None = None
        self.now_s = 0.0

    def at(self, given_s: float) -> float:
        step_s = 0.0 if self._given_s is None else given_s - self._given_s
        self._given_s = given_s
        self.now_s += min(max(step_s, 0.0), self._LONGEST_STEP_S)
        return self.now_s


class Coordinator:
    """Finds out with whom our map fits, and keeps the one global map of the group."""

    def __init__(self, robot: str, boot_id: int, options: FleetOptions | None = None) -> None:
        """`boot_id`: 64 bits, new at every start of the process."""
        self.options = options or FleetOptions()
        self.robot, self.boot = robot, boot_id
        self._ledger = Ledger(robot, boot_id, self.options)
        self._pairs = PairWork(self._ledger)
        self._composition = Composition(self._ledger)
        self._fetching = Fetching(self._ledger)
        self._rng = random.Random(f"{robot}/{boot_id}/{self.options.seed}")
        self._latest: tuple[OccupancyGrid, FeatureMap, int] | None = None  # not yet published
        self._T_map_robot: SE2 | None = None
        self._clock = _Clock()
        self._beat_seq = 0
        self._announced_m2 = 0.0
        self._next_beat_s = self._next_announce_s = self._next_scan_s = self._next_hello_s = -1e18
        self._scan_from = 0
        self._twin: _Twin | None = None
        self.is_twin = False
        self.counts: dict[str, int] = {}

    # What comes in.

    def on_local_map(self, estimate: LocalMap, features: FeatureMap, now_s: float) -> Sequence[Effect]:
        """Our own map changed; call as often as you like (at most every `announce_period_s` is announced)."""
        now_s = self._clock.at(now_s)
        self._latest = (estimate.grid, features, estimate.epoch)
        self._T_map_robot = estimate.T_map_robot
        self._announce(now_s)
        return self._done()

    def on_pose(self, T_map_robot: SE2, now_s: float) -> None:
        """Where we are in our own map; travels with the next beat."""
        self._T_map_robot = T_map_robot

    def on_message(self, message: Message, now_s: float) -> Sequence[Effect]:
        """A peer said something: already decoded, its `robot` already checked against the key it came on."""
        now_s = self._clock.at(now_s)
        if message.robot == self.robot:
            self._on_own_name(message, now_s)
            return self._done()
        peer = self._ledger.roster.hear(message, now_s)
        self._on_changes_of_life(now_s)
        if peer is None:
            return self._done()
        if peer.trust.is_quarantined(now_s) and not isinstance(message, Beat | Hello):
            self._count("from quarantine")
            return self._done()
        match message:
            case Beat():
                self._on_beat(peer, message, now_s)
            case Hello():
                peer.hello = message
            case MapAnnouncement():
                self._on_announcement(peer, message, now_s)
            case Statement():
                self._on_statement(peer, message, now_s)
            case GlobalMeta() if peer.meta is None or message.seq > peer.meta.seq:
                peer.meta = message
            case _:
                pass
        return self._done()

    def on_garbage(self, robot: str, reason: str, now_s: float) -> Sequence[Effect]:
        """Bytes came on a key of this robot that no honest robot sends (they did not decode, or named somebody else)."""
        now_s = self._clock.at(now_s)
        self._count("garbage")
        peer = self._ledger.peers.get(robot)
        if peer is not None:
            self._pairs.strike(peer, "garbage", now_s)
        return self._done()

    def on_fetched(self, fetch: Fetch, message: Message | None, now_s: float) -> Sequence[Effect]:
        """The answer to a `Fetch`; None: nobody answered, or not with what was promised."""
        now_s = self._clock.at(now_s)
        peer = self._ledger.peers.get(fetch.peer)
        is_from_it = peer is not None and message is not None and (message.robot, message.boot) == (peer.robot, peer.boot)
        subject = self._fetching.done(fetch, is_from_it, now_s)
        if subject is None or peer is None or message is None or not is_from_it or peer.trust.is_quarantined(now_s):
            return self._done()
        match message:
            case MapAnnouncement():
                self._on_announcement(peer, message, now_s)
            case Statements():
                self._on_statements(peer, message, now_s)
            case GlobalMeta() if peer.meta is None or message.seq >= peer.meta.seq:
                peer.meta = message
            case CoarseMap():
                peer.coarse = message
            case FineTiles():
                self._on_fine(peer, message, now_s)
            case GlobalTiles():
                self._on_global_tiles(peer, message, now_s)
            case _:
                pass
        self._next_scan_s = now_s
        return self._done()

    def on_match_done(self, job: Match, result: MergeResult | None, now_s: float) -> Sequence[Effect]:
        """The `MergeResult` of a `Match`; None: the job was dropped."""
        now_s = self._clock.at(now_s)
        self._pairs.on_done(job, result, now_s)
        self._ledger.judge_pair(self.robot, job.peer, now_s)
        self._lay_out(now_s)
        self._next_scan_s = now_s
        return self._done()

    def on_fused(self, job: Fuse, fused: Fused | None, now_s: float) -> Sequence[Effect]:
        """The `FusedMap` of a `Fuse`; None: the job was dropped."""
        now_s = self._clock.at(now_s)
        self._composition.on_fused(job, fused, now_s)
        return self._done()

    def tick(self, now_s: float) -> Sequence[Effect]:
        """Call about ten times a second: beats, retries, presence."""
        now_s = self._clock.at(now_s)
        self._check_twin(now_s)
        self._announce(now_s)
        if now_s >= self._next_beat_s:
            self._beat(now_s)
        if now_s >= self._next_scan_s:
            self._next_scan_s = now_s + _SCAN_PERIOD_S
            self._scan(now_s)
        return self._done()

    def unmerge(self, peer: str, now_s: float) -> Sequence[Effect]:
        """The operator takes a peer out of our map, until `readmit`."""
        now_s = self._clock.at(now_s)
        known = self._ledger.peers.get(peer)
        if known is not None and not known.is_unmerged:
            known.is_unmerged = True
            self._pairs.withdraw(peer, "unmerged by the operator", now_s)
            self._ledger.judge_all(peer, now_s)
            self._ledger.note("unmerged", peer=peer)
            self._lay_out(now_s)
            self._next_scan_s = now_s
        return self._done()

    def readmit(self, peer: str, now_s: float) -> Sequence[Effect]:
        """The operator allows a peer again: ends `unmerge` and quarantine."""
        now_s = self._clock.at(now_s)
        known = self._ledger.peers.get(peer)
        if known is not None:
            known.is_unmerged = False
            known.trust.pardon()
            self._pairs.pairs.pop(peer, None)
            self._ledger.judge_all(peer, now_s)
            self._lay_out(now_s)
        return self._done()

    # What others ask.

    def register(self, key: str) -> bytes | None:
        """The encoded answer to a query on our subtree, at most 16 KB; None: there is no such register."""
        if self.is_twin:
            return None
        own, blobs = self._ledger.own, self._ledger.own.blobs
        match key.split("/"):
            case ["hello"]:
                return encode(self._hello(self._uptime_s))
            case ["map", "feat"]:
                return encode(own.announcement) if own.announcement else None
            case ["map", "coarse"]:
                coarse = own.coarse()
                return blobs.answer(coarse) if coarse else None
            case ["map", "fine", base, target] if _DIGEST.fullmatch(base) and _DIGEST.fullmatch(target):
                return own.fine(_digest(base), _digest(target))
            case ["edge", other]:
                statement = self._ledger.mine.get(other)
                return encode(statement) if statement else None
            case ["edges"]:
                return blobs.answer(self._statements())
            case ["global", "meta"]:
                return blobs.answer(self._composition.meta) if self._composition.meta else None
            case ["global", "tiles", base, target] if _DIGEST.fullmatch(base) and _DIGEST.fullmatch(target):
                return own.global_tiles(self._composition.history, _digest(base), _digest(target))
            case ["blob", digest, index] if re.fullmatch(r"[0-9a-f]{64}", digest) and re.fullmatch(r"\d{1,5}", index):
                return blobs.chunk(bytes.fromhex(digest), int(index))
        return None

    def state(self, now_s: float) -> FleetState:
        """The fleet as we see it."""
        now_s = self._clock.at(now_s)
        group, ledger = self._ledger.group, self._ledger
        global_map = self._composition.global_map
        root = self._composition.root if group is not None and self._composition.root in group.T_root else None
        seen = group.rerooted(root) if group is not None and root else group
        frames: Mapping[str, FrameState] = {}
        if seen is not None:
            frames = {
                robot: FrameState(T, seen.covariance[robot], self._silent_s(robot, now_s)) for robot, T in seen.T_root.items()
            }
        rejected = {edge.id for edge in ledger.layout.rejected}
        return FleetState(
            self.robot,
            self.is_twin,
            seen.root if seen is not None else self.robot,
            self._composition.composer,
            tuple(self._peer_state(peer, frames, now_s) for _, peer in sorted(ledger.peers.items())),
            frames,
            tuple(evidence for _, evidence in sorted(ledger.live.items())),
            tuple(evidence for _, evidence in sorted(ledger.live.items()) if evidence.id() in rejected),
            None if global_map is None else replace(global_map, T_global_robot=self._poses(frames)),
            dict(self.counts),
        )

    # Messages.

    def _on_beat(self, peer: Peer, beat: Beat, now_s: float) -> None:
        before = peer.map
        if not self._ledger.roster.accept_beat(peer, beat, now_s):
            return
        if peer.presence is not Presence.ALIVE:
            self._fetching.forget(peer.robot)
        self._check_frame(peer, before, now_s)

    def _on_announcement(self, peer: Peer, said: MapAnnouncement, now_s: float) -> None:
        old = peer.announcement
        if old is not None and old.map.frame == said.map.frame and said.map.revision <= old.map.revision:
            return
        before = peer.map
        peer.announcement = said
        self._check_frame(peer, before, now_s)

    def _on_statement(self, peer: Peer, said: Statement, now_s: float) -> None:
        known = peer.statements.get(said.other)
        if known is not None and said.seq <= known.seq:
            if said.seq == known.seq and said != known:
                self._pairs.strike(peer, "equivocation", now_s)
            return
        if said.other == self.robot:
            self._pairs.on_proposal(peer, said, now_s)
        peer.statements[said.other], peer.statements_digest = said, None
        peer.statements_seq = max(peer.statements_seq, said.seq)
        self._after_statements(peer, [said], now_s)

    def _on_statements(self, peer: Peer, said: Statements, now_s: float) -> None:
        self._after_statements(peer, newer_statements(peer, said), now_s)

    def _after_statements(self, peer: Peer, changed: list[Statement], now_s: float) -> None:
        peer.said_s = now_s
        for statement in changed:
            self._ledger.judge_pair(peer.robot, statement.other, now_s)
        if any(statement.other == self.robot for statement in changed):
            self._pairs.on_said(peer, now_s)
            self._ledger.judge_pair(self.robot, peer.robot, now_s)
            self._next_scan_s = now_s
        self._lay_out(now_s)

    def _on_fine(self, peer: Peer, said: FineTiles, now_s: float) -> None:
        base = peer.maps.get(said.delta.base_digest) if said.delta.base_digest else None
        try:
            if said.delta.base_digest and base is None:
                return  # our newest was dropped meanwhile; the next pull asks for everything
            tiles = said.delta.apply(base)
        except RemoteProtocolError as error:
            self._ledger.note("forged-map", is_warning=True, peer=peer.robot, reason=str(error))
            self._pairs.strike(peer, "forged map", now_s)
            return
        peer.maps.add(tiles)
        if peer.held is not None and peer.held.frame != said.map.frame:
            peer.anchor = None
        is_newest = peer.held is None or peer.held.frame != said.map.frame or said.map.revision > peer.held.revision
        if is_newest:
            peer.hold(said.map, tiles.grid())
        else:
            peer.versions[said.map.digest] = said.map

    def _on_global_tiles(self, peer: Peer, said: GlobalTiles, now_s: float) -> None:
        try:
            self._composition.on_tiles(said)
        except RemoteProtocolError:
            self._pairs.strike(peer, "forged global map", now_s)

    def _admit(self, peer: Peer, now_s: float) -> None:
        """Let a member's new cells into the global map, unless they contradict its own earlier ones, or ours."""
        assert peer.held is not None and peer.grid is not None
        group, own = self._ledger.group, self._ledger.own
        if group is None or peer.robot not in group.T_root or own.grid is None or own.version is None:
            self._accept(peer)
            return
        judged = (own.version.digest, peer.held.digest)
        pair = self._pairs.pair(peer.robot)
        is_neighbour = pair_key(self.robot, peer.robot) in self._ledger.live
        is_checked = is_neighbour and pair.checked_digests == judged and pair.failures == 0
        if is_checked or (not is_neighbour and self._is_vouched_for(peer)):
            self._accept(peer)
            return
        if peer.judged == judged:
            return  # contradicts; waits for a check
        peer.judged = judged
        moved = agreement(peer.anchor, peer.grid, SE2.identity()) if peer.anchor is not None else None
        if moved is not None and moved.walls >= 40 and moved.wall_conflict_share > self.options.broken_word_share:
            self._pairs.strike(peer, "map broke its word", now_s)
            self._lay_out(now_s)
            return
        is_steady = moved is None or moved.wall_conflict_share <= self.options.max_self_conflict
        if not is_neighbour:
            if is_steady:
                self._accept(peer)
            return
        T_ours_theirs = group.T_root[self.robot].inverse() @ group.T_root[peer.robot]
        against = agreement(own.grid, peer.grid, T_ours_theirs).wall_conflict_share
        if is_steady and against <= max(pair.conflict_share, 0.0) + self.options.max_new_conflict:
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

    def _check_frame(self, peer: Peer, before: MapVersion | None, now_s: float) -> None:
        frame = peer.map.frame if peer.map else None
        if frame is not None and (before is None or before.frame != frame):
            self._on_new_frame(peer.robot, now_s)

    def _on_new_frame(self, robot: str, now_s: float) -> None:
        self._pairs.drop_void(robot)
        self._ledger.judge_all(robot, now_s)
        self._lay_out(now_s)

    def _on_changes_of_life(self, now_s: float) -> None:
        roster = self._ledger.roster
        for robot in roster.joined:
            self._ledger.note("peer-joined", peer=robot)
            self._next_hello_s = min(self._next_hello_s, now_s)
        for robot in roster.restarted:
            self._ledger.note("peer-restarted", peer=robot)
            self._pairs.drop_void(robot)
            self._fetching.forget(robot)
            self._ledger.judge_all(robot, now_s)
            for other in self._ledger.peers:
                self._ledger.judge_pair(robot, other, now_s)
            self._ledger.judge_pair(robot, self.robot, now_s)
        for robot in roster.twins:
            if self._count(f"twins of {robot}") == 1:
                self._ledger.note("twin", is_warning=True, peer=robot)
        if roster.restarted:
            self._lay_out(now_s)
        roster.joined, roster.restarted, roster.twins = [], [], []

    # Another process with our name.

    def _on_own_name(self, message: Message, now_s: float) -> None:
        if message.boot == self.boot or not isinstance(message, Beat):
            return
        if self._twin is None or self._twin.boot != message.boot:
            self._twin = _Twin(message.boot)
        twin = self._twin
        if message.seq <= twin.seq or now_s - twin.heard_s < 0.5 * message.period_s:
            return  # late beats of our own former life come in bursts
        twin.seq, twin.beats, twin.heard_s = message.seq, twin.beats + 1, now_s
        if twin.beats < 2:
            return
        is_younger = (self._uptime_s, -self.boot) < (message.uptime_s, -message.boot)
        if is_younger and not self.is_twin:
            self.is_twin = True
            self._ledger.note("twin", is_warning=True, robot=self.robot, advice="another process uses this name: rename one")

    def _check_twin(self, now_s: float) -> None:
        if self.is_twin and self._twin is not None and now_s - self._twin.heard_s > self.options.lost_after_s:
            self.is_twin, self._twin = False, None

    @property
    def _uptime_s(self) -> float:
        return self._clock.now_s

    # What goes out by itself.

    def _announce(self, now_s: float) -> None:
        """Publish the newest state of our own map, not too often."""
        if self._latest is None or now_s < self._next_announce_s:
            return
        (grid, features, epoch), self._latest = self._latest, None
        own = self._ledger.own
        before = own.version
        if not own.publish(grid, features, frame_id(self.robot, self.boot, epoch)):
            return
        self._next_announce_s = now_s + self.options.announce_period_s
        assert own.version is not None and own.announcement is not None
        if before is not None and before.frame != own.version.frame:
            self._on_new_frame(self.robot, now_s)
        is_new_frame = before is None or before.frame != own.version.frame
        if is_new_frame or own.known_area_m2 > self._announced_m2 * (1.0 + self.options.announce_growth):
            self._announced_m2 = own.known_area_m2
            self._ledger.send(own.announcement)
        self._next_scan_s = min(self._next_scan_s, now_s)

    def _beat(self, now_s: float) -> None:
        heard = sum(peer.presence is not Presence.LOST for peer in self._ledger.peers.values())
        period_s = max(self.options.beat_period_s, heard / self.options.max_beats_per_s)
        self._next_beat_s = now_s + period_s * (1.0 + self.options.beat_jitter * self._rng.uniform(-1.0, 1.0))
        self._beat_seq += 1
        held = self._composition.global_map
        self._ledger.send(
            Beat(
                self.robot,
                self.boot,
                self._beat_seq,
                self._uptime_s,
                period_s,
                self._ledger.own.version,
                statements_digest(self._ledger.mine.values()),
                held.id() if held else NO_DIGEST,
                self._T_map_robot,
                self.options.is_frozen,
                0.0,
                self._ledger.own.known_area_m2,
            )
        )
        if self._next_hello_s <= now_s:
            self._next_hello_s = 1e18
            self._ledger.send(self._hello(self._uptime_s))

    def _hello(self, uptime_s: float) -> Hello:
        own = self._ledger.own
        resolution_m = own.tiles.resolution_m if own.tiles else 0.05
        return Hello(
            self.robot, self.boot, uptime_s, MAJOR_VERSION, MAJOR_VERSION, SOFTWARE, resolution_m, self.options.is_frozen
        )

    def _statements(self) -> Statements:
        mine = sorted(self._ledger.mine.values(), key=lambda statement: statement.other)
        return Statements(self.robot, self.boot, self._ledger.seq, tuple(mine))

    # The regular round.

    def _scan(self, now_s: float) -> None:
        for peer in self._ledger.roster.update_presence(now_s):
            self._ledger.note(f"peer-{peer.presence.value}", peer=peer.robot)
        everyone = list(self._ledger.peers.values())
        count = min(_SCANNED_PEERS, len(everyone))
        turn = list(itertools.islice(itertools.cycle(everyone), self._scan_from, self._scan_from + count)) if everyone else []
        self._scan_from = (self._scan_from + count) % max(len(everyone), 1)
        for peer in turn:
            self._pull_words(peer, now_s)
            if peer.held != peer.admitted:
                self._admit(peer, now_s)
        self._pairs.next_job(turn, now_s)
        self._pull_maps(turn, now_s)

    def _pull_words(self, peer: Peer, now_s: float) -> None:
        """Small registers whose version in the beat is not the one we hold."""
        beat = peer.beat
        if beat is None or peer.presence is Presence.LOST or now_s - peer.beat_s < _GRACE_S:
            return
        if not self._ledger.is_trusted(peer.robot, now_s):
            return
        if beat.map is not None and (peer.announcement is None or peer.announcement.map.frame != beat.map.frame):
            self._fetching.want(peer.robot, "feat", "map/feat", now_s)
        if peer.statements_digest is None:
            peer.statements_digest = statements_digest(peer.statements.values())
        if peer.beat_s >= peer.said_s and beat.edges_digest != peer.statements_digest:
            self._fetching.want(peer.robot, "edges", "edges", now_s)
        meta_id = peer.meta.id() if peer.meta else NO_DIGEST
        is_wanted = peer.robot == self._composition.composer or self._composition.awaits_meta(peer.robot)
        if is_wanted and beat.global_digest not in (NO_DIGEST, meta_id):
            self._fetching.want(peer.robot, "global", "global/meta", now_s)

    def _pull_maps(self, turn: list[Peer], now_s: float) -> None:
        missing = self._composition.step(now_s)
        for robot, digest in missing:
            peer = self._ledger.peers.get(robot)
            if peer is not None and peer.presence is not Presence.LOST:
                self._pull_fine(peer, digest, now_s)
        tiles = self._composition.wanted_tiles()
        if tiles is not None:
            base = self._composition.history.newest
            key = global_register(base.digest if base else NO_DIGEST, tiles[1])
            self._fetching.want(tiles[0], "tiles", key, now_s)
        for peer in turn:
            pair = self._pairs.pairs.get(peer.robot)
            if pair is None or peer.presence is Presence.LOST:
                continue
            if pair.wants_fine:
                self._pull_fine(peer, NO_DIGEST, now_s)
            elif pair.wants_coarse:
                self._fetching.want(peer.robot, "coarse", "map/coarse", now_s)

    def _pull_fine(self, peer: Peer, target: bytes, now_s: float) -> None:
        if peer.map is None or (target == NO_DIGEST and peer.held == peer.map):
            return
        newest = peer.maps.newest
        is_same_frame = peer.held is not None and peer.held.frame == peer.map.frame
        base = newest.digest if newest is not None and is_same_frame else NO_DIGEST
        self._fetching.want(peer.robot, "fine", fine_register(base, target), now_s)

    def _lay_out(self, now_s: float) -> None:
        before = self._ledger.layout
        self._ledger.lay_out()
        if self._ledger.layout is before:
            return
        rejected = {edge.id for edge in before.rejected}
        for edge in self._ledger.layout.rejected:
            if edge.id not in rejected:
                self._ledger.note("edge-contradicts-loops", is_warning=True, a=edge.a, b=edge.b)
        self._next_scan_s = now_s

    # Small things.

    def _done(self) -> list[Effect]:
        effects, self._ledger.effects = self._ledger.effects, []
        if self.is_twin:
            return [effect for effect in effects if not isinstance(effect, Send)]
        return effects

    def _count(self, what: str) -> int:
        if what in self.counts or len(self.counts) < 200:
            self.counts[what] = self.counts.get(what, 0) + 1
        return self.counts.get(what, 0)

    def _silent_s(self, robot: str, now_s: float) -> float:
        peer = self._ledger.peers.get(robot)
        return now_s - peer.heard_s if peer else 0.0

    def _peer_state(self, peer: Peer, frames: Mapping[str, FrameState], now_s: float) -> PeerState:
        pair = self._pairs.pairs.get(peer.robot)
        beat = peer.beat
        T_map_robot, frame = beat.T_map_robot if beat else None, frames.get(peer.robot)
        live: Evidence | None = self._ledger.live.get(pair_key(self.robot, peer.robot))
        return PeerState(
            peer.robot,
            peer.presence,
            now_s - peer.heard_s,
            peer.is_frozen,
            peer.trust.is_quarantined(now_s),
            peer.is_unmerged,
            peer.map,
            peer.known_area_m2,
            peer.held is not None and peer.held == peer.map,
            beat.load if beat else 0.0,
            round(peer.trust.strikes),
            frame.T_global_map @ T_map_robot if frame is not None and T_map_robot is not None else None,
            "merged" if live is not None else pair.phase if pair else "unseen",
            pair.reason if pair else "",
            pair.attempts if pair else 0,
            live.match_factor if live is not None else pair.match_factor if pair else 0.0,
        )

    def _poses(self, frames: Mapping[str, FrameState]) -> dict[str, SE2]:
        poses = {}
        for robot, frame in frames.items():
            peer = self._ledger.peers.get(robot)
            T_map_robot = self._T_map_robot if robot == self.robot else peer.beat.T_map_robot if peer and peer.beat else None
            if T_map_robot is not None:
                poses[robot] = frame.T_global_map @ T_map_robot
        return poses


def frame_id(robot: str, boot: int, epoch: int) -> int:
    """The name of a map frame: no other robot, boot or epoch has the same."""
    return int.from_bytes(hashlib.sha256(f"{robot}/{epoch}".encode() + struct.pack("<Q", boot)).digest()[:8], "little")


def _digest(text: str) -> bytes:
    return b"" if text == "-" else bytes.fromhex(text)
