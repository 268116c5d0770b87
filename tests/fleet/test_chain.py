"""Three robots in an office of which the first and the last have no room in common: the real engine makes one map of all."""

from __future__ import annotations

import functools

import pytest

from agent.features.snapshot import MapSnapshot
from agent.fleet.effects import Match, MatchKind
from agent.merging.matching import match_maps, verify_match
from agent.merging.result import MatchOptions, MergeResult
from hw.sim.worlds import office
from protocol.geometry import SE2
from protocol.grid import UNKNOWN, OccupancyGrid
from tests.fleet.explorer import Explorer
from tests.fleet.processes import Node
from tests.fleet.simulation import Fleet

PARTS = {"r0": (0.0, 0.5), "r1": (0.25, 0.78), "r2": (0.52, 1.0)}  # of the office, from west to east


@functools.lru_cache(maxsize=16)
def snapshot(grid: OccupancyGrid) -> MapSnapshot:
    return MapSnapshot.of(grid)


def engine(fleet: Fleet, node: Node, job: Match) -> MergeResult:
    ours, theirs = snapshot(job.ours), snapshot(job.theirs)
    if job.kind is MatchKind.VERIFY and job.T_ours_theirs is not None:
        return verify_match(ours, theirs, job.T_ours_theirs, MatchOptions())
    return match_maps(ours, theirs, MatchOptions())


def test_a_chain_of_three_robots_is_one_map() -> None:
    world = office(0).truth()
    fleet = Fleet(1, judge=engine)
    for i, (name, (west, east)) in enumerate(PARTS.items()):
        explorer = Explorer.at(world, SE2(1.0 + 5.0 * i, 2.0, 0.0), 0.4 + 0.9 * i)
        explorer.seen[:, int(west * world.width) : int(east * world.width)] = True
        explorer.seen &= world.cells != UNKNOWN
        fleet.add(name, explorer)
    fleet.run_until(lambda: fleet.agrees(list(PARTS)), 20.0)
    coordinator, held = fleet.nodes["r2"].coordinator, fleet.nodes["r2"].global_map
    assert coordinator is not None and held is not None
    assert {(edge.robot_a, edge.robot_b) for edge in coordinator.state(fleet.now_s).edges} == {("r0", "r1"), ("r1", "r2")}
    for member in held.members:
        assert member.T_global_map.distance_m(fleet.true_T(held.root, member.robot)) < 0.1
    assert held.grid.known_area_m2() == pytest.approx(world.known_area_m2(), rel=0.02)
