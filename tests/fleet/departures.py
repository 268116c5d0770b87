"""A day on which one robot dies for good, and perhaps another comes later: the others end with one map, the dead one's in it.

Agreement is judged among those who are left: the same members, the same edges between them and the same cells, everywhere.
That the map of the robot that is gone stays in it is counted, not demanded: its last words may have reached nobody.
"""

from __future__ import annotations

from dataclasses import dataclass

from agent.fleet.state import FleetState
from tests.fleet.processes import Node
from tests.fleet.schedules import Outcome, Schedule

NETWORK_FAULTS = ("loss", "delay", "duplicates", "partition", "one_way")
ALL_KNOW_S = 15.0  # a quiet while before it dies, on most days
LIMIT_S = 90.0


@dataclass
class Departed(Outcome):
    """What one such day showed."""

    is_kept: bool = False  # the map of the robot that is gone is in the global one


class Departure(Schedule):
    """At least three robots; one dies, and of the others one may have been away all the time."""

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        while len(self.fleet.nodes) < 3:
            self.fleet.add(f"r{len(self.fleet.nodes)}", self._explorer(), self.options)
        self.outcome = Departed(seed, len(self.fleet.nodes))

    def run(self) -> Departed:
        rng, fleet = self.rng, self.fleet
        fleet.run(rng.uniform(2.0, 8.0))
        gone, late = (fleet.nodes[name] for name in rng.sample(sorted(fleet.nodes), 2))
        is_late = rng.random() < 0.7
        if is_late:
            fleet.crash(late)
        for _ in range(rng.randint(0, 2)):
            fault = rng.choice(NETWORK_FAULTS)
            self.outcome.faults.append(fault)
            getattr(self, "_" + fault)()
            fleet.run(rng.uniform(0.5, 4.0))
        if rng.random() < 0.7:
            fleet.heal()
            fleet.link.loss, fleet.link.delay_s = 0.0, (0.005, 0.03)
            fleet.run(ALL_KNOW_S)
        fleet.crash(gone)
        if is_late:
            fleet.run(rng.uniform(0.0, 20.0))
        self._settle(gone)
        return self.outcome

    def _settle(self, gone: Node) -> None:
        """Faults stop, everybody is up but the one."""
        del self.fleet.nodes[gone.name]
        self._calm()
        self.fleet.nodes[gone.name] = gone
        self.outcome.converged_s = self.fleet.run_until(lambda: self._agree(gone), LIMIT_S)

    def _agree(self, gone: Node) -> bool:
        here = [node for node in self.fleet.nodes.values() if node is not gone]
        states = {node.robot: node.coordinator.state(self.fleet.local_s(node)) for node in here if node.coordinator is not None}
        groups = {robot: set(state.frames) or {robot} for robot, state in states.items()}
        for robot, members in groups.items():
            for other in members & groups.keys():
                if groups[other] != members or _edges(states[other], members, gone) != _edges(states[robot], members, gone):
                    return False
            if len(members) > 1 and not self._is_one_map(members, members & groups.keys()):
                return False
        if any(self._should_be_connected(a, b, states) for a in here for b in here if a.robot < b.robot):
            return False
        self.outcome.connected = max(map(len, groups.values()))
        self.outcome.is_kept = any(gone.robot in members for members in groups.values())
        return True

    def _is_one_map(self, members: set[str], here: set[str]) -> bool:
        maps = [self.fleet.nodes[robot].global_map for robot in sorted(here)]
        first = maps[0]
        if first is None or {member.robot for member in first.members} != members:
            return False
        return all(held is not None and (held.digest, held.members) == (first.digest, first.members) for held in maps)


def _edges(state: FleetState, members: set[str], gone: Node) -> set[bytes]:
    """Live edges of one group between robots that are left."""
    pairs = [(evidence, {evidence.robot_a, evidence.robot_b}) for evidence in state.edges]
    return {evidence.id() for evidence, pair in pairs if pair <= members and gone.robot not in pair}


def run_departure(seed: int) -> Departed:
    """One such day; an AssertionError says what did not come true."""
    return Departure(seed).run()
