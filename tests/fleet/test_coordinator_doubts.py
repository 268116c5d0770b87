"""What a coordinator does with words that are wrong, late, doubled, forged or from nobody it should believe."""

from __future__ import annotations

import random
from dataclasses import replace

import numpy as np
import pytest

from agent.fleet.coordinator import Coordinator
from agent.fleet.effects import Fetch, Fuse, Match, MatchKind, Send
from agent.fleet.options import FleetOptions
from agent.fleet.peer import Peer
from agent.fleet.roster import Roster
from agent.merging.result import MatchFactor, MatchStatus, MergeResult
from protocol.codec import decode, encode
from protocol.features import FeatureMap
from protocol.geometry import SE2
from protocol.grid import FREE, OccupancyGrid
from protocol.messages import Beat, FineTiles, MapAnnouncement, MapVersion, Message, Stance, Statement
from protocol.tiles import TileMap
from tests.fleet.explorer import Explorer, random_world
from tests.fleet.groups import PLACES, WORLD, edges, events, fleet_of, names
from tests.fleet.processes import Node
from tests.fleet.simulation import Fleet, truthful
from tests.protocol.examples import evidence


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


def test_a_composer_that_was_stopped_while_it_fused_composes_on_as_before() -> None:
    fleet = fleet_of(2)
    fleet.run_until(lambda: fleet.agrees(names(2)), 10.0)
    fleet.run(3.0)
    composer, other, fuse = fleet.nodes["r0"], fleet.nodes["r1"], fleet._fuse

    def stopped(node: Node, job: Fuse) -> None:
        fuse(node, job)
        if node is composer:
            node.clock_offset_s += 60.0
            fleet._fuse = fuse  # type: ignore[method-assign]

    def area_m2() -> float:
        return composer.global_map.grid.known_area_m2() if composer.global_map is not None else 0.0

    fleet._fuse = stopped  # type: ignore[method-assign]
    for place in (PLACES[4], PLACES[5]):
        assert other.explorer is not None
        before_m2 = area_m2()
        other.explorer.look(place, 12)
        fleet.share_map(other)
        assert fleet.run_until(lambda: area_m2() > before_m2, 20.0) < 5.0  # noqa: B023
    assert fleet._fuse == fuse


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
    answer = decode(other.register(fetch.key) or b"")
    assert isinstance(answer, FineTiles)
    forged = replace(answer, delta=replace(answer.delta, digest=bytes(16)), map=replace(answer.map, digest=bytes(16)))
    coordinator.on_fetched(fetch, forged, 0.3)
    peer = coordinator._ledger.peers["r1"]
    assert peer.held is None
    assert peer.trust.strikes == pytest.approx(1.0)


def test_late_doubled_and_reordered_words_change_nothing() -> None:
    fleet = fleet_of(2)
    node = fleet.nodes["r0"]
    assert node.coordinator is not None
    heard: list[Message] = []
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


def test_statements_about_robots_that_nobody_knows_stay_bounded() -> None:
    coordinator = Coordinator("r0", 1, FleetOptions(max_peers=20))
    coordinator.on_message(Beat("x", 1, 1, 1.0, 1.0, None, b"", b""), 0.0)
    for i in range(200):
        coordinator.on_message(Statement("x", 1, i + 1, f"y{i}", Stance.PROPOSE, evidence()), 0.1)
    assert coordinator.counts["statements about too many"] == 180


def test_however_many_old_versions_a_peer_hands_out_few_are_kept() -> None:
    peer = Peer("x", 1, 0.0, 0.0)
    for revision in range(100):
        tiles = TileMap.of(OccupancyGrid(np.full((8, 8 + revision), FREE, np.int8), 0.05))
        peer.add_map(MapVersion(1, revision, tiles.digest), tiles)
    assert len(peer.versions) == len(peer.maps.digests()) < 10


def test_a_full_table_forgets_lost_strangers_before_lost_members() -> None:
    roster = Roster(FleetOptions(max_peers=2))
    for robot in ("member", "stranger"):
        roster.hear(Beat(robot, 1, 1, 1.0, 1.0, None, b"", b""), 0.0 if robot == "member" else 1.0)
    assert roster.hear(Beat("new", 1, 1, 1.0, 1.0, None, b"", b""), 2.0) is None
    roster.peers["member"].admitted = MapVersion(1, 1, bytes(16))
    roster.update_presence(100.0)
    roster.hear(Beat("new", 1, 1, 1.0, 1.0, None, b"", b""), 100.0)
    assert set(roster.peers) == {"member", "new"}


def test_in_a_fleet_larger_than_one_turn_the_most_alike_is_looked_at_first() -> None:
    coordinator, explorer = Coordinator("r0", 1, FleetOptions(strangers_at_once=4)), Explorer.at(WORLD, PLACES[0], 0.0)
    explorer.look(PLACES[0], 12)
    rng = np.random.default_rng(1)
    ours, *others = (FeatureMap(lines=rng.uniform(1.0, 90.0, (5, 6)).astype(np.float32)) for _ in range(151))
    coordinator.on_local_map(explorer, ours, 0.0)
    for i, features in enumerate([*others, ours]):
        version = MapVersion(i + 1, 1, bytes([i]) * 16)
        coordinator.on_message(MapAnnouncement(f"x{i:03}", i, version, 0.5, 100.0, 1_000, features, False), 0.01)
        coordinator.on_message(Beat(f"x{i:03}", i, 1, 1.0, 1.0, version, b"", b""), 0.01)
    asked = []
    for t in range(1, 8):
        for effect in coordinator.tick(0.2 * t):
            if isinstance(effect, Fetch):
                asked.append(effect.peer)
                coordinator.on_fetched(effect, None, 0.2 * t)
    assert "x150" in asked


def test_a_member_that_gives_way_to_strangers_is_out_of_everything() -> None:
    fleet = fleet_of(3, options=FleetOptions(max_peers=4))
    fleet.run_until(lambda: fleet.agrees(names(3)), 20.0)
    node = fleet.nodes["r1"]
    coordinator = node.coordinator
    assert coordinator is not None
    fleet.crash(fleet.nodes["r2"])
    for second in range(60):
        for i in range(4):
            beat = Beat(f"x{i}", 1, second + 1, float(second), 1.0, None, b"", b"")
            fleet.carry_out(node, coordinator.on_message(beat, fleet.now_s))
        fleet.run(1.0)
    assert "r2" not in {peer.robot for peer in coordinator.state(fleet.now_s).peers}
    assert edges(node) == {("r0", "r1")}
    assert set(coordinator._pairs.pairs) == set(coordinator._ledger.peers)
    assert "r2" not in coordinator._ledger.mine
