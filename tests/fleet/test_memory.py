"""A robot that restarts with its map on disk is in the fleet map again without a search."""

from __future__ import annotations

import itertools
import random
from dataclasses import replace

import pytest

from agent.fleet.coordinator import Coordinator
from agent.fleet.effects import Match, MatchKind
from agent.fleet.memory import FleetMemory, decode_memory
from agent.merging.result import MatchStatus, MergeResult
from protocol.geometry import SE2
from protocol.messages import Beat
from tests.fleet.explorer import Explorer, random_world
from tests.fleet.processes import Node
from tests.fleet.simulation import Fleet, truthful

NAMES = ["r0", "r1", "r2"]
MEMORY = FleetMemory(3, {"r1": SE2(1.5, -2.0, 0.25), "r7": SE2(0.0, 0.0, 3.0)}, ("r9",))


def merged_fleet() -> tuple[Fleet, list[Match]]:
    fleet, searches = Fleet(4), []

    def judge(fleet: Fleet, node: Node, job: Match) -> MergeResult:
        if job.kind is not MatchKind.VERIFY:
            searches.append(job)
        return truthful(fleet, node, job)

    fleet.judge = judge
    world = random_world(4, 60.0, 0.5)
    for i, place in enumerate((SE2(-5, -4, 0.3), SE2(4, 2, -2.0), SE2(2, 8, 1.2))):
        explorer = Explorer.at(world, place, 0.7 * i)
        explorer.look(place, 12.0)
        fleet.add(NAMES[i], explorer)
    fleet.run_until(lambda: fleet.agrees(NAMES), 20.0)
    return fleet, searches


@pytest.mark.parametrize("names", [["r0"], ["r2"], NAMES])
def test_robots_that_restart_with_their_maps_are_together_again_in_seconds_without_a_search(names: list[str]) -> None:
    fleet, searches = merged_fleet()
    searches.clear()
    kept = {}
    for name in names:
        coordinator = fleet.nodes[name].coordinator
        assert coordinator is not None
        kept[name] = decode_memory(coordinator.memory().encode())
        fleet.crash(fleet.nodes[name])
    fleet.run(3.0)
    for name in names:
        fleet.start(fleet.nodes[name], kept[name])
    assert fleet.run_until(lambda: fleet.agrees(NAMES), 10.0) < 5.0
    assert not [job for job in searches if job.peer in names]


def test_what_is_remembered_of_another_map_is_not_tried() -> None:
    fleet, searches = merged_fleet()
    searches.clear()
    node = fleet.nodes["r2"]
    assert node.coordinator is not None and node.explorer is not None
    memory = node.coordinator.memory()
    fleet.crash(node)
    node.explorer = Explorer.at(node.explorer.world, SE2(6, -6, 1.0), 2.0)
    node.explorer.epoch = 2
    node.explorer.look(node.explorer.T_world_robot, 12.0)
    fleet.start(node, memory)
    fleet.run_until(lambda: fleet.agrees(NAMES), 20.0)
    assert node.coordinator.memory().epoch == 2
    held = fleet.nodes["r0"].global_map
    assert held is not None
    place = next(member for member in held.members if member.robot == "r2").T_global_map
    assert place.distance_m(fleet.true_T("r0", "r2")) < 1e-5


def test_a_peer_that_began_anew_elsewhere_is_searched_for_though_its_old_place_would_be_believed() -> None:
    fleet, searches = merged_fleet()
    searches.clear()
    judge = fleet.judge

    def credulous(fleet: Fleet, node: Node, job: Match) -> MergeResult:
        result = judge(fleet, node, job)
        return result if job.kind is not MatchKind.VERIFY else replace(result, status=MatchStatus.MERGED)

    fleet.judge = credulous
    node = fleet.nodes["r2"]
    fleet.crash(node)
    assert node.explorer is not None
    node.explorer = Explorer.at(node.explorer.world, SE2(6, -6, 1.0), 2.0)
    node.explorer.look(node.explorer.T_world_robot, 12.0)
    fleet.start(node)
    fleet.run_until(lambda: fleet.agrees(NAMES), 20.0)
    assert [job for job in searches if job.peer == "r2"]
    held = fleet.nodes["r0"].global_map
    assert held is not None
    place = next(member for member in held.members if member.robot == "r2").T_global_map
    assert place.distance_m(fleet.true_T("r0", "r2")) < 1e-5


def test_whom_the_operator_took_out_stays_out() -> None:
    fleet, _ = merged_fleet()
    node = fleet.nodes["r0"]
    assert node.coordinator is not None
    for peer in ("r1", "r2"):
        fleet.carry_out(node, node.coordinator.unmerge(peer, fleet.now_s))
    memory = node.coordinator.memory()
    fleet.crash(node)
    fleet.start(node, memory)
    fleet.run(15.0)
    assert node.global_map is None
    assert {peer.robot for peer in node.coordinator.state(fleet.now_s).peers if peer.is_unmerged} == {"r1", "r2"}


def test_whom_the_operator_took_out_stays_out_over_lives_in_which_it_is_not_heard() -> None:
    lives = [Coordinator("r0", boot) for boot in (1, 2, 3)]
    lives[0].on_message(Beat("r9", 1, 1, 1.0, 1.0, None, b"", b""), 0.0)
    lives[0].unmerge("r9", 0.0)
    for earlier, later in itertools.pairwise(lives):
        later.recall(earlier.memory())
    assert lives[2].memory().unmerged == ("r9",)
    lives[2].readmit("r9", 0.0)
    assert lives[2].memory().unmerged == ()


def test_a_life_that_draws_no_map_keeps_what_is_remembered_and_of_which_map_it_is() -> None:
    coordinator = Coordinator("r0", 1)
    coordinator.recall(MEMORY)
    assert coordinator.memory() == MEMORY


def test_memory_reads_as_written_and_anything_else_is_nothing() -> None:
    assert decode_memory(MEMORY.encode()) == MEMORY
    rng = random.Random(1)
    for _ in range(300):
        damaged = bytearray(MEMORY.encode())
        for _ in range(rng.randint(1, 6)):
            damaged[rng.randrange(len(damaged))] = rng.randrange(256)
        found = decode_memory(bytes(damaged))
        assert found is None or isinstance(found, FleetMemory)
    pose = b'{"epoch":0,"places":{%s},"unmerged":[]}'
    broken = [pose % b'"r1":[1,2]', pose % b'"R 1":[1,2,3]', pose % b'"r1":[NaN,2,3]']
    for bad in (b"", b"[]", b"{}", b"[" * 100_000, *broken):
        assert decode_memory(bad) is None
