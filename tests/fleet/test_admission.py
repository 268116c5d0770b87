"""Maps that take back what they said: an honest robot's is checked again and never punished, an invention is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from agent.fleet.admission import Admission
from agent.fleet.ledger import Ledger, pair_key
from agent.fleet.own_map import _KEPT_VERSIONS
from agent.fleet.peer import Peer
from protocol.features import FeatureMap
from protocol.geometry import SE2
from protocol.grid import FREE, OCCUPIED, OccupancyGrid
from tests.fleet.explorer import Explorer, random_world
from tests.fleet.groups import fleet_of, names
from tests.fleet.lying_maps import Liar
from tests.fleet.simulation import Fleet

NAMES = ["r0", "r1", "r2"]


def bent(grid: OccupancyGrid, cells: int) -> OccupancyGrid:
    """One half of the map moved: another particle, with another corridor behind it, became the best."""
    half = grid.width // 2
    moved = grid.cells.copy()
    moved[:, half:] = np.roll(moved[:, half:], cells, axis=0)
    return replace(grid, cells=moved)


def merged_fleet(seed: int) -> Fleet:
    fleet = Fleet(seed)
    world = random_world(seed, 60.0, 0.5)
    for i, place in enumerate((SE2(-5, -4, 0.3), SE2(4, 2, -2.0), SE2(2, 8, 1.2))):
        explorer = Explorer.at(world, place, 0.7 * i)
        explorer.look(place, 12.0)
        fleet.add(NAMES[i], Liar.like(explorer))
    fleet.run_until(lambda: fleet.agrees(NAMES), 20.0)
    return fleet


def show(fleet: Fleet, change: Callable[[OccupancyGrid], OccupancyGrid]) -> None:
    node = fleet.nodes["r1"]
    assert isinstance(node.explorer, Liar)
    node.explorer.change = change
    fleet.share_map(node)


def events(fleet: Fleet, event: str) -> set[str]:
    return {name for name, node in fleet.nodes.items() for note in node.notes if note.event == event}


def with_invented_walls(grid: OccupancyGrid) -> OccupancyGrid:
    cells = grid.cells.copy()
    free = np.argwhere(cells == FREE)
    chosen = free[np.random.default_rng(1).permutation(len(free))[: len(free) // 30]]
    cells[chosen[:, 0], chosen[:, 1]] = OCCUPIED
    return replace(grid, cells=cells)


@pytest.mark.parametrize("cells", [1, 2, 4, 8])
def test_a_robot_that_redraws_its_map_again_and_again_is_never_quarantined(cells: int) -> None:
    fleet = merged_fleet(4)
    for i in range(10):
        show(fleet, lambda grid, by=cells * (i % 2): bent(grid, by))  # type: ignore[misc]
        fleet.run(6.0)
    assert not events(fleet, "quarantined")
    show(fleet, lambda grid: grid)
    fleet.run_until(lambda: fleet.agrees(NAMES), 60.0)


def test_walls_that_two_others_do_not_see_wait_and_the_agreed_map_stays() -> None:
    fleet = merged_fleet(4)
    before = fleet.digests()
    show(fleet, with_invented_walls)
    fleet.run(20.0)
    assert events(fleet, "held-back") == {"r0", "r2"}
    assert {fleet.digests()[name] for name in ("r0", "r2")} == {before["r0"]}
    assert not events(fleet, "quarantined")
    show(fleet, lambda grid: grid)
    fleet.run_until(lambda: "r0" in events(fleet, "taken-in-again") and fleet.agrees(NAMES), 10.0)


@pytest.mark.parametrize("value", [FREE, OCCUPIED])
def test_a_map_that_denies_itself_is_quarantined_at_once(value: int) -> None:
    fleet = merged_fleet(4)
    show(fleet, lambda grid: replace(grid, cells=np.full_like(grid.cells, value)))
    fleet.run_until(lambda: bool(events(fleet, "quarantined")), 5.0)
    fleet.run_until(lambda: fleet.agrees(["r0", "r2"]), 10.0)


@pytest.mark.parametrize(("robots", "is_followed"), [(3, False), (5, True)])
def test_a_robot_alone_with_its_doubt_follows_what_many_follow(robots: int, is_followed: bool) -> None:
    """Refusals are judgements on noisy maps: with nobody else to ask they stand, against the many they yield."""
    fleet, everybody = fleet_of(robots), names(robots)
    fleet.run_until(lambda: fleet.agrees(everybody), 20.0)
    doubter, doubted = everybody[-1], fleet.nodes["r1"]
    admission = fleet.nodes[doubter].coordinator._admission  # type: ignore[union-attr]
    believe = admission._is_believed
    admission._is_believed = lambda peer, *args, **facts: peer.robot != "r1" and believe(peer, *args, **facts)  # type: ignore[method-assign]
    assert doubted.explorer is not None
    doubted.explorer.look(SE2(6, 6, 0.0), 12.0)
    fleet.share_map(doubted)
    fleet.run(40.0)
    assert any(note.event == "held-back" for note in fleet.nodes[doubter].notes)
    assert fleet.agrees(everybody) == is_followed


@pytest.mark.parametrize("is_used", [True, False])
def test_the_version_a_recipe_uses_can_be_pulled_however_long_ago_it_was(is_used: bool) -> None:
    fleet = fleet_of(2)
    fleet.run_until(lambda: fleet.agrees(names(2)), 20.0)
    own = fleet.nodes["r1"].coordinator._ledger.own  # type: ignore[union-attr]
    assert own.version is not None and own.grid is not None
    used = own.pinned
    assert used == own.version.digest
    own.pinned = used if is_used else b""
    for i in np.argwhere(own.grid.cells.ravel() != OCCUPIED)[: _KEPT_VERSIONS + 1, 0]:
        cells = own.grid.cells.copy()
        cells.flat[i] = OCCUPIED
        assert own.publish(replace(own.grid, cells=cells), FeatureMap(), own.version.frame)
    assert (own.fine(b"", used) is not None) == is_used


def admission_of(fleet: Fleet) -> tuple[Admission, Peer]:
    """How r0 judges the cells of r1."""
    coordinator = fleet.nodes["r0"].coordinator
    assert coordinator is not None
    return coordinator._admission, coordinator._ledger.peers["r1"]


def test_cells_held_back_from_a_neighbour_are_judged_anew_when_it_is_one_no_longer() -> None:
    fleet = merged_fleet(4)
    admission, peer = admission_of(fleet)
    admission._is_believed = lambda *args, **facts: not admission._is_neighbour(peer)  # type: ignore[method-assign]
    admission._is_checked, peer.judged = lambda peer: False, ()  # type: ignore[method-assign]
    admission.admit(peer, fleet.now_s)
    assert peer.held_back_s is not None
    admission._is_neighbour = lambda peer: False  # type: ignore[method-assign]
    admission.admit(peer, fleet.now_s)
    assert peer.held_back_s is None


@pytest.mark.parametrize("witnesses", [0, 1, 2])
@pytest.mark.parametrize("edge", ["lives", "taken back", "none"])
def test_doubts_about_a_recipe_count_at_first_hand_or_with_two_witnesses(edge: str, witnesses: int) -> None:
    fleet = merged_fleet(4)
    admission, peer = admission_of(fleet)
    ledger = admission._ledger
    assert peer.held is not None
    if edge == "taken back":
        admission._pairs.words.withdraw("r1", "map turned false", fleet.now_s)
    elif edge == "none":
        ledger.mine.pop("r1")
    if edge != "lives":
        ledger.live.pop(pair_key("r0", "r1"))
    admission._hold_back(peer, SE2.identity(), witnesses, fleet.now_s)
    assert (peer.held.digest in peer.refused) == (edge != "none" or witnesses == 2)


def test_the_same_cells_are_judged_anew_after_a_twin_s_came_between(monkeypatch: pytest.MonkeyPatch) -> None:
    fleet = merged_fleet(4)
    admission, peer = admission_of(fleet)
    assert peer.held is not None
    peer.judged = ()
    admission.admit(peer, fleet.now_s)
    ours, peer.held = peer.held, replace(peer.held, frame=peer.held.frame ^ 1)  # the twin's, while r1 is in no group
    with monkeypatch.context() as alone:
        alone.setattr(Ledger, "group", None)
        admission.admit(peer, fleet.now_s)
    peer.held = ours
    admission.admit(peer, fleet.now_s)
    assert peer.admitted == ours
