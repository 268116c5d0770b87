"""One seeded day in the life of a fleet: robots explore, everything breaks, the faults stop, and the invariants must hold.

I1  the fleet logic never stops a robot: every call returns
I2  a peer never alters a robot's own map
I3  every live edge is true, and rests on statements of both sides
I4  once faults stop, everybody who can be connected holds the same frames, the same edges and the same global map
I5  memory is bounded by the number of robots
I6  no exception leaves the coordinator
"""

from __future__ import annotations

import random
from dataclasses import dataclass, field

from agent.fleet.effects import Match
from agent.fleet.ledger import agreed
from agent.fleet.options import FleetOptions
from agent.fleet.state import FleetState
from agent.merging.result import MergeResult
from protocol.geometry import SE2, wrap_angle
from protocol.tiles import TileMap
from tests.fleet.explorer import Explorer, judged, random_world
from tests.fleet.processes import Link, Node
from tests.fleet.simulation import Fleet

FAULTS = ("loss", "delay", "duplicates", "partition", "one-way", "crash", "restart", "twin", "clock", "freeze", "unmerge")
CELL_M, SIDE_M = 1.0, 48.0
CALM_LIMIT_S = 60.0
REFINED_M, REFINED_RAD = 2.0 * CELL_M, 0.2


@dataclass
class Outcome:
    """What one schedule showed."""

    seed: int
    robots: int
    faults: list[str] = field(default_factory=list)
    converged_s: float = 0.0  # after the faults stopped
    connected: int = 0  # robots in the group that had to agree
    wrong_edges: int = 0


class Schedule:
    """The robots, the nemesis and the judge of one seed."""

    def __init__(self, seed: int) -> None:
        self.rng = random.Random(seed)
        rng = self.rng
        self.outcome = Outcome(seed, rng.randint(2, 5))
        self.world = random_world(seed % 50, SIDE_M, CELL_M)
        self.fleet = Fleet(seed, link=Link(loss=rng.choice((0.0, 0.0, 0.05, 0.2))), judge=refining)
        self.options = FleetOptions(
            retry_period_s=1.0,
            retry_change_s=2.0,
            reverify_period_s=1.0,
            announce_period_s=1.0,
            compose_period_s=1.0,
            fetch_timeout_s=8.0,
        )
        for i in range(self.outcome.robots):
            self.fleet.add(f"r{i}", self._explorer(), self.options)
        self.is_exploring = True
        self.fleet.at(1.0, self._explore)

    def run(self) -> Outcome:
        for _ in range(self.rng.randint(1, 4)):
            self.fleet.run(self.rng.uniform(0.5, 4.0))
            fault = self.rng.choice(FAULTS)
            self.outcome.faults.append(fault)
            getattr(self, "_" + fault.replace("-", "_"))()
            self.check_always()
        self.fleet.run(self.rng.uniform(0.5, 6.0))
        self._calm()
        self.outcome.converged_s = self.fleet.run_until(self._has_converged, CALM_LIMIT_S)
        self.check_always()
        self._check_edges()
        return self.outcome

    # Exploring.

    def _explorer(self) -> Explorer:
        rng, reach = self.rng, SIDE_M / 5
        place = SE2(rng.uniform(-reach, reach), rng.uniform(-reach, reach), rng.uniform(-3, 3))
        explorer = Explorer.at(self.world, place, rng.uniform(-3, 3))
        explorer.look(place, radius_m=rng.uniform(5, 12))
        return explorer

    def _explore(self) -> None:
        for node in self.fleet.nodes.values():
            if node.is_up and node.explorer is not None and self.is_exploring and self.rng.random() < 0.5:
                here = node.explorer.T_world_robot
                step = SE2(self.rng.uniform(0.0, 2.0), 0.0, self.rng.uniform(-1.0, 1.0))
                there = here @ step
                if max(abs(there.x_m), abs(there.y_m)) < SIDE_M / 2 - 4:
                    node.explorer.look(there)
                    self.fleet.share_map(node)
        self.fleet.at(1.0, self._explore)

    # The nemesis.

    def _node(self) -> Node:
        return self.rng.choice([node for node in self.fleet.nodes.values() if node.name == node.robot])

    def _loss(self) -> None:
        self.fleet.link.loss = self.rng.uniform(0.1, 0.6)

    def _delay(self) -> None:
        self.fleet.link.delay_s = (0.01, self.rng.uniform(0.2, 3.0))

    def _duplicates(self) -> None:
        self.fleet.link.duplicates = self.rng.uniform(0.1, 0.9)

    def _partition(self) -> None:
        names = list(self.fleet.nodes)
        self.rng.shuffle(names)
        cut = self.rng.randint(1, max(1, len(names) - 1))
        self.fleet.split(names[:cut], names[cut:])

    def _one_way(self) -> None:
        a, b = self._node(), self._node()
        self.fleet.blocked.add((a.name, b.name))

    def _crash(self) -> None:
        self.fleet.crash(self._node())

    def _restart(self) -> None:
        """A new life in a new map frame, somewhere else."""
        node = self._node()
        self.fleet.crash(node)
        node.explorer = self._explorer()
        self.fleet.at(self.rng.uniform(0.0, 3.0), lambda: None if node.is_up else self.fleet.start(node))

    def _twin(self) -> None:
        node = self._node()
        if node.is_up and f"{node.name}-twin" not in self.fleet.nodes:
            self.fleet.add(f"{node.name}-twin", self._explorer(), self.options, robot=node.robot)

    def _clock(self) -> None:
        self._node().clock_offset_s += self.rng.choice((-86_400.0, -3_600.0, -5.0, 5.0, 3_600.0, 86_400.0))

    def _freeze(self) -> None:
        """SIGSTOP: nothing is read or said for a while, then everything at once."""
        node = self._node()
        others = [other.name for other in self.fleet.nodes.values() if other is not node]
        self.fleet.split([node.name], others)

    def _unmerge(self) -> None:
        node, other = self._node(), self._node()
        if node.coordinator is not None and node is not other:
            self.fleet.carry_out(node, node.coordinator.unmerge(other.robot, self.fleet.local_s(node)))
            self.fleet.at(self.rng.uniform(1.0, 4.0), lambda: self._readmit(node, other.robot))

    def _readmit(self, node: Node, robot: str) -> None:
        if node.coordinator is not None:
            self.fleet.carry_out(node, node.coordinator.readmit(robot, self.fleet.local_s(node)))

    def _calm(self) -> None:
        """All faults stop: a good network, everybody up, no twins, nobody unmerged."""
        fleet = self.fleet
        fleet.heal()
        fleet.link.loss, fleet.link.delay_s, fleet.link.duplicates = 0.0, (0.005, 0.03), 0.0
        for name in [node.name for node in fleet.nodes.values() if node.name != node.robot]:
            fleet.crash(fleet.nodes[name])
            del fleet.nodes[name]
        for node in fleet.nodes.values():
            if not node.is_up:
                fleet.start(node)
            for other in fleet.nodes.values():
                self._readmit(node, other.robot)
        self.is_exploring = False

    # The judge.

    def check_always(self) -> None:
        robots = len(self.fleet.nodes)
        for node in self.fleet.nodes.values():
            if node.coordinator is None or node.explorer is None:
                continue
            ledger = node.coordinator._ledger
            own = ledger.own
            if own.tiles is not None and own.grid is not None:
                assert TileMap.of(own.grid, own.tiles).digest == own.tiles.digest, f"I2: {node.name}'s own map was altered"
            assert len(ledger.peers) <= robots, f"I5: {node.name} knows {len(ledger.peers)} peers of {robots}"
            for peer in ledger.peers.values():
                assert len(peer.versions) <= len(peer.maps.digests()) <= 6, "I5: maps"
                assert len(peer.statements) <= robots and len(peer.ghosts) <= 4, "I5: words"
            for evidence in ledger.live.values():
                both = ledger.statement(evidence.robot_a, evidence.robot_b), ledger.statement(evidence.robot_b, evidence.robot_a)
                assert agreed(*both) is not None, "I3: an edge without two statements"

    def _check_edges(self) -> None:
        for node in self.fleet.nodes.values():
            assert node.coordinator is not None
            for evidence in node.coordinator._ledger.live.values():
                T = self.fleet.true_T(evidence.robot_a, evidence.robot_b)
                if T.distance_m(evidence.T_a_b) > 1.0:
                    self.outcome.wrong_edges += 1
        assert self.outcome.wrong_edges == 0, f"I3: {self.outcome.wrong_edges} wrong edges live"

    def _has_converged(self) -> bool:
        """I4: in every group the true edges connect, one global map of exactly its robots, made from the newest maps."""
        nodes = list(self.fleet.nodes.values())
        states = {node.robot: node.coordinator.state(self.fleet.local_s(node)) for node in nodes if node.coordinator is not None}
        edges = {robot: frozenset(e.id() for e in state.edges) for robot, state in states.items()}
        if len(set(edges.values())) != 1:
            return False
        for robot, state in states.items():
            members = set(state.frames) or {robot}
            for other in members:
                if set(states[other].frames or {other}) != members:
                    return False
            if len(members) > 1 and not self._holds_one_map(sorted(members)):
                return False
        if any(self._should_be_connected(a, b, states) for a in nodes for b in nodes if a.robot < b.robot):
            return False
        self.outcome.connected = max(len(state.frames) for state in states.values())
        return True

    def _holds_one_map(self, members: list[str]) -> bool:
        if not self.fleet.agrees(members):
            return False
        global_map = self.fleet.nodes[members[0]].global_map
        assert global_map is not None
        for member in global_map.members:
            coordinator = self.fleet.nodes[member.robot].coordinator
            if coordinator is None or coordinator._ledger.own.version != member.map:
                return False
        return True

    def _should_be_connected(self, a: Node, b: Node, states: dict[str, FleetState]) -> bool:
        """Whether two robots see enough in common to be merged, and are not in one group."""
        state = states[a.robot]
        if b.robot in state.frames:
            return False
        assert a.explorer is not None and b.explorer is not None
        T = self.fleet.true_T(a.robot, b.robot)
        there = judged(a.explorer.grid, b.explorer.grid, T)
        return there.accepted and judged(b.explorer.grid, a.explorer.grid, T.inverse()).accepted


def refining(fleet: Fleet, node: Node, job: Match) -> MergeResult:
    """Verification refines: what is nearly right, a place where a robot began anew beside its old one, ends at the truth."""
    truth, T = fleet.true_T(node.robot, job.peer), job.T_ours_theirs
    is_near = T is None or (T.distance_m(truth) < REFINED_M and abs(wrap_angle(T.theta_rad - truth.theta_rad)) < REFINED_RAD)
    return judged(job.ours, job.theirs, T if T is not None and not is_near else truth)


def run_schedule(seed: int) -> Outcome:
    """One schedule; an AssertionError names the invariant that broke."""
    return Schedule(seed).run()
