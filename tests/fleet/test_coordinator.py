"""Stories of a fleet, told by the real coordinators over a simulated network."""

from __future__ import annotations

import math
import random
from dataclasses import replace

import numpy as np
import pytest

from agent.fleet.coordinator import Coordinator
from agent.fleet.effects import Fetch, Match, MatchKind, Send
from agent.fleet.options import FleetOptions
from agent.merging.fusion import fuse
from agent.merging.result import MatchFactor, MatchStatus, MergeResult
from protocol.codec import encode
from protocol.features import FeatureMap
from protocol.geometry import SE2
from protocol.messages import Beat, GlobalMeta, MapAnnouncement, Stance, Statement
from protocol.tiles import TileMap
from tests.fleet.simulation import Explorer, Fleet, Link, Node, random_world, truthful

WORLD = random_world(1, 60.0, 0.5)
PLACES = [SE2(-6, -5, 0.3), SE2(4, 2, -2.0), SE2(12, -8, 1.2), SE2(-10, 10, 2.6), SE2(3, 13, -0.7), SE2(-14, -4, 0.1)]


def fleet_of(
    n: int, *, seed: int = 1, link: Link | None = None, options: FleetOptions | None = None, radius_m: float = 12
) -> Fleet:
    fleet = Fleet(seed, link=link)
    for i in range(n):
        explorer = Explorer.at(WORLD, PLACES[i], 0.7 * i)
        explorer.look(PLACES[i], radius_m)
        fleet.add(f"r{i}", explorer, options)
    return fleet


def names(n: int) -> list[str]:
    return [f"r{i}" for i in range(n)]


def edges(node: Node) -> set[tuple[str, str]]:
    assert node.coordinator is not None
    return {(e.robot_a, e.robot_b) for e in node.coordinator.state(0.0).edges}


def events(node: Node, event: str) -> list[object]:
    return [note for note in node.notes if note.event == event]


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


def test_a_wrong_search_is_refused_by_the_other_side() -> None:
    def judge(fleet: Fleet, node: Node, job: Match) -> MergeResult:
        if job.kind is MatchKind.SEARCH:
            wrong = fleet.true_T(node.robot, job.peer) @ SE2(4.0, 1.0, 0.2)
            return MergeResult(MatchStatus.MERGED, wrong, np.eye(3) * 1e-3, MatchFactor(900, 10), 200.0, 99.0, reason="wrong")
        return truthful(fleet, node, job)

    fleet = fleet_of(2)
    fleet.judge = judge
    fleet.run(20.0)
    assert not edges(fleet.nodes["r0"])
    assert fleet.nodes["r0"].global_map is None
    assert fleet.nodes["r1"].coordinator._ledger.mine["r0"].stance is Stance.REJECT  # type: ignore[union-attr]


def test_one_wrong_edge_among_good_ones_is_named_and_not_used() -> None:
    def judge(fleet: Fleet, node: Node, job: Match) -> MergeResult:
        if {node.robot, job.peer} == {"r0", "r3"}:  # both sides are fooled alike: two identical rooms
            wrong = fleet.true_T("r0", "r3") @ SE2(5.0, -3.0, 0.5)
            T = wrong if node.robot == "r0" else wrong.inverse()
            return MergeResult(MatchStatus.MERGED, T, np.eye(3) * 1e-4, MatchFactor(900, 10), 100.0, 60.0, reason="twins")
        return truthful(fleet, node, job)

    fleet = fleet_of(5)
    fleet.judge = judge
    fleet.run_until(lambda: fleet.agrees(names(5)), 40.0)
    fleet.run(10.0)
    held = fleet.nodes["r4"].global_map
    assert held is not None
    for member in held.members:
        assert member.T_global_map.distance_m(fleet.true_T(held.root, member.robot)) < 0.3
    if ("r0", "r3") in edges(fleet.nodes["r4"]):
        rejected = fleet.nodes["r4"].coordinator.state(fleet.now_s).rejected_edges  # type: ignore[union-attr]
        assert {(e.robot_a, e.robot_b) for e in rejected} == {("r0", "r3")}


def test_an_edge_is_withdrawn_when_the_maps_turn_against_it() -> None:
    fleet = fleet_of(2)
    fleet.run_until(lambda: fleet.agrees(names(2)), 10.0)
    node = fleet.nodes["r1"]
    other_world = random_world(99, 60.0, 0.5)
    assert node.explorer is not None
    node.explorer = replace(node.explorer, world=other_world, seen=node.explorer.seen.copy())
    node.explorer.look(PLACES[0], 14)
    fleet.share_map(node)
    fleet.run_until(lambda: not edges(fleet.nodes["r0"]) and not edges(node), 15.0)
    fleet.run_until(lambda: fleet.nodes["r0"].global_map is None, 5.0)
    assert events(fleet.nodes["r0"], "withdrawn") or events(node, "withdrawn")


def test_twins_are_noticed_within_two_beats_and_the_younger_falls_silent() -> None:
    fleet = fleet_of(2)
    fleet.run_until(lambda: fleet.agrees(names(2)), 10.0)
    explorer = Explorer.at(WORLD, PLACES[3], 1.0)
    explorer.look(PLACES[3], 12)
    twin = fleet.add("twin", explorer, robot="r1")
    assert twin.coordinator is not None
    assert fleet.run_until(lambda: twin.coordinator.is_twin, 10.0) < 4.0  # type: ignore[union-attr]
    assert not fleet.nodes["r0"].coordinator._ledger.peers["r1"].ghosts  # type: ignore[union-attr]  # the elder was believed
    fleet.run_until(lambda: fleet.agrees(names(2)), 15.0)
    assert not fleet.nodes["r1"].coordinator.is_twin  # type: ignore[union-attr]
    assert twin.coordinator.register("map/feat") is None
    fleet.crash(twin)
    fleet.run(30.0)
    assert fleet.agrees(names(2))


def test_nothing_depends_on_the_clock_being_right() -> None:
    fleet = fleet_of(3)
    offsets = iter((1e6, -1e6, 86_400.0, -3_600.0, 0.0, 5e8))
    for node in [*fleet.nodes.values(), *fleet.nodes.values()]:
        node.clock_offset_s = next(offsets)
        fleet.run(1.0)
    fleet.run_until(lambda: fleet.agrees(names(3)), 20.0)
    assert not [note for node in fleet.nodes.values() for note in node.notes if note.event == "peer-lost"]


def test_a_statement_changed_under_its_number_ends_in_quarantine() -> None:
    fleet = fleet_of(3)
    fleet.run_until(lambda: fleet.agrees(names(3)), 20.0)
    liar = fleet.nodes["r2"].coordinator
    assert liar is not None
    honest = liar._ledger.mine["r0"]
    forged = replace(honest, evidence=replace(honest.evidence, T_a_b=SE2(9.0, 9.0, 1.0)))
    node = fleet.nodes["r0"]
    assert node.coordinator is not None
    fleet.carry_out(node, node.coordinator.on_message(forged, fleet.now_s))
    assert {p.robot: p.is_quarantined for p in node.coordinator.state(fleet.now_s).peers} == {"r1": False, "r2": True}
    assert not any("r2" in pair for pair in edges(node))


def test_cells_that_are_not_what_was_announced_are_not_taken() -> None:
    fleet = fleet_of(2)
    coordinator = fleet.nodes["r0"].coordinator
    other = fleet.nodes["r1"].coordinator
    assert coordinator is not None and other is not None
    coordinator.on_message(other._ledger.own.announcement, 0.1)  # type: ignore[arg-type]
    effects = list(coordinator.tick(0.2))
    fetch = next(effect for effect in effects if isinstance(effect, Fetch))
    from protocol.codec import decode  # noqa: PLC0415

    answer = decode(other.register(fetch.key))  # type: ignore[arg-type]
    forged = replace(answer, delta=replace(answer.delta, digest=bytes(16)), map=replace(answer.map, digest=bytes(16)))  # type: ignore[union-attr, call-arg]
    coordinator.on_fetched(fetch, forged, 0.3)
    peer = coordinator._ledger.peers["r1"]
    assert peer.held is None
    assert peer.trust.strikes == pytest.approx(1.0)


def test_late_doubled_and_reordered_words_change_nothing() -> None:
    fleet = fleet_of(2)
    node = fleet.nodes["r0"]
    assert node.coordinator is not None
    heard: list[object] = []
    original = node.coordinator.on_message

    def listen(message, now_s):  # type: ignore[no-untyped-def]
        heard.append(message)
        return original(message, now_s)

    node.coordinator.on_message = listen  # type: ignore[method-assign]
    fleet.run_until(lambda: fleet.agrees(names(2)), 10.0)
    fleet.run(3.0)
    before = fleet.digests(), edges(node)
    random.Random(1).shuffle(heard)
    for message in heard:
        fleet.carry_out(node, original(message, fleet.now_s))
    fleet.run(5.0)
    assert (fleet.digests(), edges(node)) == before
    assert not node.coordinator.state(fleet.now_s).peers[0].is_quarantined


def test_a_register_answers_only_what_exists() -> None:
    fleet = fleet_of(2)
    fleet.run_until(lambda: fleet.agrees(names(2)), 10.0)
    coordinator = fleet.nodes["r0"].coordinator
    assert coordinator is not None
    for key in ("hello", "map/feat", "map/coarse", "map/fine/-/-", "edge/r1", "edges", "global/meta", "global/tiles/-/-"):
        answer = coordinator.register(key)
        assert answer is not None and len(answer) <= 16_384, key
    bad = ("", "x", "map", "map/fine/-", "map/fine/zz/-", "map/fine/-/" + "0" * 32, "blob/00/0", "blob/" + "0" * 64 + "/0",
           "edge/nobody", "../hello", "map/fine/" + "A" * 32 + "/-", "blob/" + "0" * 64 + "/99999999")  # fmt: skip
    assert [key for key in bad if coordinator.register(key) is not None] == []


def test_everything_sent_can_be_encoded_and_is_small_enough_to_push() -> None:
    coordinator = Coordinator("r0", 1)
    rng = np.random.default_rng(1)
    explorer = Explorer.at(WORLD, PLACES[0], 0.0)
    explorer.look(PLACES[0], 12)
    many = rng.uniform(-500, 500, (5_000, 6)).astype(np.float32)
    features = FeatureMap(lines=many, arcs=many, circles=many[:, :4], curves=many[:, :5])
    sent = [e.message for e in coordinator.on_local_map(explorer, features, 0.0) if isinstance(e, Send)]
    sent += [e.message for e in coordinator.tick(0.1) if isinstance(e, Send)]
    assert {type(message) for message in sent} >= {MapAnnouncement, Beat}
    assert max(len(encode(message)) for message in sent) <= 16_384


def test_a_table_full_of_strangers_stays_bounded() -> None:
    coordinator = Coordinator("r0", 1, FleetOptions(max_peers=20))
    for i in range(200):
        coordinator.on_message(Beat(f"x{i}", i, 1, 1.0, 1.0, None, b"", b""), 0.1 * i)
    assert len(coordinator.state(20.0).peers) == 20


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
