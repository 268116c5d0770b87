"""Everything one coordinator knows, in one place, and the small questions all its parts ask."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable

from agent.fleet.effects import Effect, Note, Send
from agent.fleet.frame_graph import Edge, Group, Layout, connected, solve
from agent.fleet.options import FleetOptions
from agent.fleet.own_map import OwnMap
from agent.fleet.peer import Peer
from agent.fleet.roster import Roster
from agent.fleet.timetable import Clock, Timetable
from protocol.geometry import SE2, wrap_angle
from protocol.messages import NO_DIGEST, Evidence, Message, Stance, Statement

PairKey = tuple[str, str]  # (smaller id, larger id)


def pair_key(a: str, b: str) -> PairKey:
    return (a, b) if a < b else (b, a)


class Ledger:
    """The shared memory of all parts of a `Coordinator`."""

    def __init__(self, robot: str, boot: int, options: FleetOptions) -> None:
        self.robot, self.boot, self.options = robot, boot, options
        self.own = OwnMap(robot, boot, is_frozen=options.is_frozen)
        self.roster = Roster(options)
        self.mine: dict[str, Statement] = {}  # our statements, by the other robot
        self.seq = 0
        self.live: dict[PairKey, Evidence] = {}
        self._edges: dict[PairKey, Edge] = {}  # of `live`
        self._layout = Layout()
        self._connected = {robot}  # everybody whom a chain of live edges joins to us, when the layout was solved
        self._is_layout_old = False
        self._rejected: frozenset[bytes] | None = None  # None: not asked for since the edges changed
        self.effects: list[Effect] = []
        self.clock, self.timetable = Clock(), Timetable()
        self.counts: dict[str, int] = {}
        self._next_id = 0

    @property
    def peers(self) -> dict[str, Peer]:
        return self.roster.peers

    @property
    def layout(self) -> Layout:
        """The frames of all that is connected to us, solved when they are asked for: statements come in crowds."""
        if self._is_layout_old:
            self._is_layout_old = False
            self._solve()
        return self._layout

    @property
    def group(self) -> Group | None:
        """The group we are in; None while we are alone."""
        return self.layout.group_of.get(self.robot)

    def new_id(self) -> int:
        self._next_id += 1
        return self._next_id

    def send(self, message: Message) -> None:
        self.effects.append(Send(message))

    def note(self, event: str, *, is_warning: bool = False, **facts: object) -> None:
        self.effects.append(Note(event, facts, is_warning))

    def is_trusted(self, robot: str, now_s: float) -> bool:
        """Whether a robot's words count here."""
        if robot == self.robot:
            return True
        peer = self.peers.get(robot)
        return peer is not None and robot not in self.roster.unmerged and not peer.trust.is_quarantined(now_s)

    def frame_of(self, robot: str) -> int | None:
        """The map frame a robot draws in now."""
        if robot == self.robot:
            return self.own.version.frame if self.own.version else None
        peer = self.peers.get(robot)
        version = peer.map if peer else None
        return version.frame if version else None

    def is_current(self, evidence: Evidence) -> bool:
        """Whether it speaks of the frames both robots draw in now."""
        frames = self.frame_of(evidence.robot_a), self.frame_of(evidence.robot_b)
        return frames == (evidence.map_a.frame, evidence.map_b.frame)

    def from_our_side(self, evidence: Evidence) -> SE2:
        """T_ours_theirs of evidence about a pair of ours."""
        return evidence.T_a_b if self.robot == evidence.robot_a else evidence.T_a_b.inverse()

    def is_same(self, T: SE2 | None, other: SE2) -> bool:
        """Whether two transforms of one pair mean the same."""
        if T is None:
            return False
        turn_rad = abs(wrap_angle(T.theta_rad - other.theta_rad))
        return T.distance_m(other) < self.options.same_transform_m and turn_rad < self.options.same_transform_rad

    def renew_period_s(self) -> float:
        """Everybody hears every renewal, so large fleets renew less often."""
        return self.options.renew_period_s * max(1.0, len(self.peers) / self.options.max_beats_per_s)

    def statement(self, author: str, other: str) -> Statement | None:
        if author == self.robot:
            return self.mine.get(other)
        peer = self.peers.get(author)
        return peer.statements.get(other) if peer else None

    def judge_pair(self, a: str, b: str, now_s: float) -> None:
        """Look again whether the edge between two robots lives."""
        key = pair_key(a, b)
        evidence = agreed(self.statement(*key), self.statement(key[1], key[0]))
        is_believed = self.is_trusted(a, now_s) and self.is_trusted(b, now_s)
        if evidence is not None and not (is_believed and self.is_current(evidence) and self._is_borne_out(evidence)):
            evidence = None
        if evidence == self.live.get(key):
            return
        if evidence is None:
            del self.live[key], self._edges[key]
        else:
            if self.robot in key and key not in self.live:
                T = evidence.T_a_b
                self.note("merged", a=key[0], b=key[1], match_factor=evidence.match_factor, T_a_b=(T.x_m, T.y_m, T.theta_rad))
            self.live[key], e = evidence, evidence
            self._edges[key] = Edge(e.robot_a, e.robot_b, e.T_a_b, e.covariance, e.overlap_m2 * e.match_factor, e.id())
        self._rejected = None
        if a in self._connected or b in self._connected:
            self._is_layout_old = True
            self.timetable.next_scan_s = now_s

    def _is_borne_out(self, evidence: Evidence) -> bool:
        """Whether edges of robots that others tell of lie where the recipe has them, by which they are believed."""
        peers = [self.peers[robot] for robot in (evidence.robot_a, evidence.robot_b) if robot in self.peers]
        laid = [peer.told.T_between(evidence.robot_a, evidence.robot_b) for peer in peers if peer.told is not None]
        return all(self.is_same(T, evidence.T_a_b) for T in laid)

    def judge_all(self, robot: str, now_s: float) -> None:
        """Look again at every edge of one robot."""
        others = {key[0] if key[1] == robot else key[1] for key in self.live if robot in key}
        others |= set(self.mine if robot == self.robot else ())
        peer = self.peers.get(robot)
        others |= set(peer.statements) if peer else set()
        for other in others:
            self.judge_pair(robot, other, now_s)

    def rejected(self) -> frozenset[bytes]:
        """Ids of the live edges of any group that contradict the others."""
        if self._rejected is None:
            self._rejected = frozenset(edge.id for edge in solve(self._edges.values()).rejected)
        return self._rejected

    def _solve(self) -> None:
        """Solve the frames anew, and name the edges that came to contradict the others."""
        known = {edge.id for edge in self._layout.rejected}
        ours = connected(self._edges.values(), self.robot)
        self._layout = solve(ours)
        self._connected = {self.robot}.union(*((edge.a, edge.b) for edge in ours))
        for edge in self._layout.rejected:
            if edge.id not in known:
                self.note("edge-contradicts-loops", is_warning=True, a=edge.a, b=edge.b)

    def count(self, what: str) -> int:
        """One more of these; for status pages, bounded."""
        if what in self.counts or len(self.counts) < 200:
            self.counts[what] = self.counts.get(what, 0) + 1
        return self.counts.get(what, 0)


def supported(statement: Statement) -> set[bytes]:
    """Ids of the evidence a statement stands by."""
    stands = {statement.holds} if statement.holds and statement.stance is not Stance.WITHDRAW else set()
    return stands | {statement.evidence.id()} if statement.stance in (Stance.PROPOSE, Stance.ACK) else stands


def agreed(of_a: Statement | None, of_b: Statement | None) -> Evidence | None:
    """The evidence both sides of a pair stand by; the newest when there are two."""
    if of_a is None or of_b is None:
        return None
    common = supported(of_a) & supported(of_b)
    told = [s.evidence for s in (of_a, of_b) if s.evidence.id() in common]
    return max(told, key=lambda e: (e.map_a.revision + e.map_b.revision, e.id()), default=None)


def statements_digest(statements: Iterable[Statement]) -> bytes:
    """8 bytes over all statements of one robot; nothing for none."""
    digest = hashlib.sha256()
    ordered = sorted(statements, key=lambda statement: statement.other)
    for s in ordered:
        digest.update(f"{s.other}\n{s.stance.value}\n{s.seq}\n".encode() + s.evidence.id() + s.holds)
    return digest.digest()[:8] if ordered else NO_DIGEST
