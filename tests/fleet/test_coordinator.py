"""Stories of a fleet, told by the real coordinators over a simulated network."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from agent.fleet.coordinator import Coordinator
from agent.fleet.effects import Send
from agent.fleet.options import FleetOptions
from agent.merging.fusion import fuse
from protocol.geometry import SE2
from protocol.messages import Beat, GlobalMeta, Stance, Statement
from protocol.tiles import TileMap
from tests.fleet.explorer import Explorer
from tests.fleet.groups import PLACES, WORLD, edges, fleet_of, names
from tests.fleet.processes import Link
from tests.fleet.simulation import Fleet


def test_two_robots_agree_on_one_map_within_seconds() -> None:
    fleet = fleet_of(2)
    assert fleet.run_until(lambda: fleet.agrees(names(2)), 10.0) < 5.0
    global_map = fleet.nodes["r1"].global_map
    assert global_map is not None
    assert global_map.root == "r0"
    place = next(member for member in global_map.members if member.robot == "r1").T_global_map
    assert place.distance_m(fleet.true_T("r0", "r1")) < 1e-5


def test_the_global_map_is_what_fusing_the_local_maps_gives() -> None:
    fleet = fleet_of(3)
    fleet.run_until(lambda: fleet.agrees(names(3)), 15.0)
    global_map = fleet.nodes["r2"].global_map
    assert global_map is not None
    maps = []
    for member in global_map.members:
        explorer = fleet.nodes[member.robot].explorer
        assert explorer is not None
        maps.append((TileMap.of(explorer.grid).grid(), member.T_global_map))
    assert np.array_equal(TileMap.of(fuse(maps, 0.5).grid).grid().cells, global_map.grid.cells)


def test_six_robots_agree_over_a_bad_network() -> None:
    fleet = fleet_of(6, link=Link(loss=0.2, delay_s=(0.01, 0.5), duplicates=0.3))
    fleet.run_until(lambda: fleet.agrees(names(6)), 60.0)
    fleet.run_until(lambda: len({frozenset(edges(node)) for node in fleet.nodes.values()}) == 1, 20.0)


def test_robots_that_never_overlap_never_merge() -> None:
    fleet = Fleet(3)
    for name, x in (("r0", -22.0), ("r1", 22.0)):
        explorer = Explorer.at(WORLD, SE2(x, 0, 0), 0.0)
        explorer.look(SE2(x, 0, 0), 5.0)
        fleet.add(name, explorer)
    fleet.run(60.0)
    assert fleet.nodes["r0"].global_map is None
    assert not edges(fleet.nodes["r0"])


def test_a_chain_of_three_is_one_group() -> None:
    fleet = Fleet(4)
    for i, x in enumerate((-16.0, 0.0, 16.0)):
        explorer = Explorer.at(WORLD, SE2(x, 0, 0), 0.4 * i)
        explorer.look(SE2(x, 0, 0), 11.0)
        fleet.add(f"r{i}", explorer)
    fleet.run_until(lambda: fleet.agrees(names(3)), 20.0)
    assert edges(fleet.nodes["r0"]) == {("r0", "r1"), ("r1", "r2")}


def test_a_late_joiner_catches_up() -> None:
    fleet = fleet_of(2)
    fleet.run_until(lambda: fleet.agrees(names(2)), 10.0)
    explorer = Explorer.at(WORLD, PLACES[2], -1.0)
    explorer.look(PLACES[2], 12)
    fleet.add("r2", explorer)
    assert fleet.run_until(lambda: fleet.agrees(names(3)), 15.0) < 10.0


def test_both_sides_of_a_partition_go_on_and_agree_again_after_it() -> None:
    fleet = fleet_of(4)
    fleet.run_until(lambda: fleet.agrees(names(4)), 20.0)
    fleet.split(["r0", "r1"], ["r2", "r3"])
    fleet.run(30.0)
    for node in fleet.nodes.values():
        assert node.explorer is not None
        node.explorer.look(node.explorer.T_world_robot @ SE2(2.0, 0.0, 0.0), 12)
        fleet.share_map(node)
    fleet.run(10.0)
    assert fleet.digests()["r0"] == fleet.digests()["r1"] != fleet.digests()["r2"] == fleet.digests()["r3"]
    fleet.heal()
    fleet.run_until(lambda: fleet.agrees(names(4)), 15.0)


def test_a_growing_map_reaches_everybody_as_small_differences() -> None:
    fleet = fleet_of(2)
    fleet.run_until(lambda: fleet.agrees(names(2)), 10.0)
    before = fleet.nodes["r1"].sent["FineTiles"]
    explorer = fleet.nodes["r1"].explorer
    assert explorer is not None
    explorer.look(SE2(6, 4, 0), 12)
    fleet.share_map(fleet.nodes["r1"])
    target = TileMap.of(explorer.grid).digest

    def is_in_map() -> bool:
        held = fleet.nodes["r0"].global_map
        return held is not None and any(member.map.digest == target for member in held.members) and fleet.agrees(names(2))

    fleet.run_until(is_in_map, 10.0)
    assert fleet.nodes["r1"].sent["FineTiles"] - before < before


def test_a_restarted_robot_is_a_new_robot_and_merges_again() -> None:
    fleet = fleet_of(3)
    fleet.run_until(lambda: fleet.agrees(names(3)), 20.0)
    node = fleet.nodes["r1"]
    fleet.crash(node)
    node.explorer = Explorer.at(WORLD, PLACES[4], 2.0)
    node.explorer.look(PLACES[4], 14)
    fleet.start(node)
    fleet.run_until(lambda: fleet.agrees(names(3)), 20.0)
    held = fleet.nodes["r0"].global_map
    assert held is not None
    place = next(member for member in held.members if member.robot == "r1").T_global_map
    assert place.distance_m(fleet.true_T("r0", "r1")) < 1e-5


def test_the_root_stays_when_a_smaller_robot_joins() -> None:
    fleet = Fleet(5)
    for i in (1, 2):
        explorer = Explorer.at(WORLD, PLACES[i], 0.5)
        explorer.look(PLACES[i], 12)
        fleet.add(f"r{i}", explorer)
    fleet.run_until(lambda: fleet.agrees(["r1", "r2"]), 15.0)
    assert fleet.nodes["r2"].global_map is not None
    assert fleet.nodes["r2"].global_map.root == "r1"
    explorer = Explorer.at(WORLD, PLACES[0], 0.0)
    explorer.look(PLACES[0], 12)
    fleet.add("r0", explorer)
    fleet.run_until(lambda: fleet.agrees(names(3)), 20.0)
    roots = {node.global_map.root for node in fleet.nodes.values() if node.global_map}
    assert roots == {"r1"}


def test_the_root_stays_when_it_falls_silent() -> None:
    fleet = fleet_of(3)
    fleet.run_until(lambda: fleet.agrees(names(3)), 20.0)
    fleet.crash(fleet.nodes["r0"])
    fleet.run(40.0)
    for name in ("r1", "r2"):
        held = fleet.nodes[name].global_map
        assert held is not None
        assert held.root == "r0"
        assert held.author in ("r0", "r1")
        assert fleet.nodes[name].coordinator.state(fleet.now_s).composer == "r1"  # type: ignore[union-attr]


def test_a_given_map_is_a_peer_and_roots_its_group() -> None:
    fleet = fleet_of(2)
    given = Explorer.at(WORLD, SE2(0, 0, 0), 0.0)
    given.look(SE2(0, 0, 0), 28)
    fleet.add("office-map", given, FleetOptions(is_frozen=True))
    fleet.run_until(lambda: fleet.agrees([*names(2), "office-map"]), 20.0)
    held = fleet.nodes["r0"].global_map
    assert held is not None
    assert held.root == "office-map"
    assert held.author == "r0"


def test_unmerge_gives_the_very_map_that_never_had_the_peer() -> None:
    alone = fleet_of(2, seed=7)
    alone.run_until(lambda: alone.agrees(names(2)), 10.0)
    fleet = fleet_of(3, seed=7)
    fleet.run_until(lambda: fleet.agrees(names(3)), 15.0)
    for name in names(2):
        node = fleet.nodes[name]
        assert node.coordinator is not None
        fleet.carry_out(node, node.coordinator.unmerge("r2", fleet.now_s))
    fleet.run_until(lambda: fleet.agrees(names(2)), 15.0)
    assert fleet.digests()["r0"] == alone.digests()["r0"]
    for name in names(2):
        node = fleet.nodes[name]
        assert node.coordinator is not None
        fleet.carry_out(node, node.coordinator.readmit("r2", fleet.now_s))
    fleet.run_until(lambda: fleet.agrees(names(3)), 20.0)


def test_the_same_inputs_give_the_same_effects() -> None:
    first, second = fleet_of(4, seed=11, link=Link(loss=0.1)), fleet_of(4, seed=11, link=Link(loss=0.1))
    for fleet in (first, second):
        fleet.run(15.0)
    assert first.digests() == second.digests()
    assert [n.sent for n in first.nodes.values()] == [n.sent for n in second.nodes.values()]


def test_larger_fleets_beat_slower() -> None:
    options = FleetOptions(max_beats_per_s=5.0)
    coordinator = Coordinator("r0", 1, options)
    for i in range(50):
        coordinator.on_message(Beat(f"x{i}", i, 1, 1.0, 1.0, None, b"", b""), 0.0)
    beats = 0
    for i in range(140):
        beats += sum(isinstance(e, Send) and isinstance(e.message, Beat) for e in coordinator.tick(i * 0.1))
    assert 1 <= beats <= 3


def test_the_poses_of_everybody_are_known_in_the_global_frame() -> None:
    fleet = fleet_of(3)
    fleet.run_until(lambda: fleet.agrees(names(3)), 15.0)
    fleet.run(3.0)
    coordinator = fleet.nodes["r2"].coordinator
    assert coordinator is not None
    global_map = coordinator.state(fleet.now_s).global_map
    assert global_map is not None
    T_world_global = fleet.nodes[global_map.root].explorer.T_world_map  # type: ignore[union-attr]
    for name in names(3):
        truth = fleet.nodes[name].explorer.T_world_robot  # type: ignore[union-attr]
        found = T_world_global @ global_map.T_global_robot[name]
        assert found.distance_m(truth) < 0.01
        assert abs(math.remainder(found.theta_rad - truth.theta_rad, math.tau)) < 0.01


def test_a_recipe_of_a_lying_composer_is_not_followed() -> None:
    fleet = fleet_of(3)
    fleet.run_until(lambda: fleet.agrees(names(3)), 15.0)
    node, liar = fleet.nodes["r2"], fleet.nodes["r0"].coordinator
    assert node.coordinator is not None and liar is not None
    meta = liar._composition.meta
    assert meta is not None
    moved = tuple(replace(m, T_global_map=m.T_global_map @ SE2(3.0, 0.0, 0.0)) if m.robot == "r1" else m for m in meta.members)
    lie: GlobalMeta = replace(meta, seq=meta.seq + 100, members=moved, digest=bytes(16))
    honest = fleet.digests()["r2"]
    fleet.carry_out(node, node.coordinator.on_message(lie, fleet.now_s))
    fleet.run(20.0)
    assert fleet.digests()["r2"] == honest


def test_statements_about_a_pair_carry_the_evidence_both_stand_by() -> None:
    fleet = fleet_of(2)
    fleet.run_until(lambda: bool(edges(fleet.nodes["r0"])) and bool(edges(fleet.nodes["r1"])), 10.0)
    ours: Statement = fleet.nodes["r0"].coordinator._ledger.mine["r1"]  # type: ignore[union-attr]
    theirs: Statement = fleet.nodes["r1"].coordinator._ledger.mine["r0"]  # type: ignore[union-attr]
    assert (ours.stance, theirs.stance) == (Stance.PROPOSE, Stance.ACK)
    assert ours.evidence.id() == theirs.evidence.id()
