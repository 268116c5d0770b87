"""A robot that is gone for good left its map in the global one: whoever comes later gets it from those who hold it."""

from __future__ import annotations

from dataclasses import replace

import pytest

from agent.fleet import estates
from agent.fleet.state import Presence
from protocol.codec import decode, encode
from protocol.geometry import SE2
from protocol.messages import NO_DIGEST, Estate, Stance, Statement, Statements
from tests.fleet.groups import edges, fleet_of
from tests.fleet.lying_words import InventedRobot
from tests.fleet.processes import Node, Tap
from tests.fleet.simulation import Fleet

ALL = ["r0", "r1", "r2", "r3"]


def together(fleet: Fleet, here: list[str], members: list[str]) -> bool:
    """Whether those who are here hold one global map of all members, of those too who are gone."""
    maps = [fleet.nodes[name].global_map for name in here]
    first = maps[0]
    if first is None or {member.robot for member in first.members} != set(members):
        return False
    return all(other is not None and other.digest == first.digest and other.members == first.members for other in maps)


def one_is_gone(gone: str, newcomer: str) -> Fleet:
    """Three robots hold one map, one of them dies; then a newcomer comes that never heard of it."""
    fleet = fleet_of(4, radius_m=16)
    fleet.crash(fleet.nodes[newcomer])
    others = [name for name in ALL if name != newcomer]
    fleet.run_until(lambda: together(fleet, others, others), 60.0)
    fleet.crash(fleet.nodes[gone])
    fleet.run(20.0)
    fleet.start(fleet.nodes[newcomer])
    return fleet


def test_a_newcomer_gets_the_map_of_a_robot_that_is_gone() -> None:
    fleet = one_is_gone("r2", newcomer="r3")
    here = ["r0", "r1", "r3"]
    fleet.run_until(lambda: together(fleet, here, ALL), 60.0)
    assert {key for key in edges(fleet.nodes["r3"]) if "r2" in key} == {key for key in edges(fleet.nodes["r0"]) if "r2" in key}


def test_a_newcomer_that_composes_keeps_what_the_others_know_of_a_robot_that_is_gone() -> None:
    fleet = one_is_gone("r2", newcomer="r0")
    fleet.run_until(lambda: together(fleet, ["r0", "r1", "r3"], ALL), 60.0)


def test_a_robot_that_comes_back_speaks_for_itself_again() -> None:
    fleet = one_is_gone("r2", newcomer="r3")
    fleet.run_until(lambda: together(fleet, ["r0", "r1", "r3"], ALL), 60.0)
    fleet.start(fleet.nodes["r2"])
    fleet.run_until(lambda: fleet.agrees(ALL), 60.0)
    assert peers_of(fleet, "r3")["r2"] is Presence.ALIVE


@pytest.mark.parametrize("witnesses", [1, 2])
def test_one_robot_alone_invents_no_other(witnesses: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its recipe names a robot that nobody ever heard of; of the others nobody holds that map.  Were one enough, they would."""
    monkeypatch.setattr(estates, "_WITNESSES", witnesses)
    fleet = fleet_of(4, radius_m=16)
    fleet.run_until(lambda: fleet.agrees(ALL), 60.0)
    liar = fleet.nodes["r0"]
    liar.tap = InventedRobot()
    fleet.nodes["ghost"] = Node("ghost", "ghost", liar.explorer, liar.options)
    fleet.run(20.0)
    deceived = [name for name in ALL[1:] if "ghost" in peers_of(fleet, name)]
    assert deceived == (ALL[1:] if witnesses == 1 else [])


def peers_of(fleet: Fleet, name: str) -> dict[str, Presence]:
    coordinator = fleet.nodes[name].coordinator
    assert coordinator is not None
    return {peer.robot: peer.presence for peer in coordinator.state(fleet.now_s).peers}


@pytest.mark.parametrize("lie", ["hides", "moves"])
def test_one_heir_alone_neither_hides_nor_moves_a_robot_that_is_gone(lie: str) -> None:
    fleet = one_is_gone("r2", newcomer="r3")
    fleet.nodes["r1"].tap = FalseHeir(lie)
    fleet.run_until(lambda: "r2" in frames(fleet, "r3"), 60.0)
    fleet.run(10.0)
    coordinator = fleet.nodes["r3"].coordinator
    assert coordinator is not None
    about = [e for e in coordinator.state(fleet.now_s).edges if "r2" in (e.robot_a, e.robot_b)]
    assert about and all(e.T_a_b.distance_m(fleet.true_T(e.robot_a, e.robot_b)) < 0.5 for e in about)


def test_a_robot_that_only_one_other_knew_is_let_go() -> None:
    """The others never heard it, it cannot be asked any more, and one witness is not enough."""
    fleet = fleet_of(4, radius_m=16)
    fleet.blocked |= {("r2", "r0"), ("r2", "r3"), ("r0", "r2"), ("r3", "r2")}
    fleet.run_until(lambda: "r2" in frames(fleet, "r1"), 60.0)
    fleet.crash(fleet.nodes["r2"])
    here = ["r0", "r1", "r3"]
    fleet.run_until(lambda: all(frames(fleet, name) == set(here) for name in here) and together(fleet, here, here), 90.0)


def frames(fleet: Fleet, name: str) -> set[str]:
    coordinator = fleet.nodes[name].coordinator
    assert coordinator is not None
    return set(coordinator.state(fleet.now_s).frames)


class FalseHeir(Tap):
    """Says of a robot that is gone that it was merged with nobody, or that it agreed to lie three metres from where it lies."""

    def __init__(self, lie: str) -> None:
        self.lie = lie

    def answer(self, fleet: Fleet, node: Node, key: str, data: bytes | None) -> bytes | None:
        said = decode(data) if data else None
        if isinstance(said, Estate):
            words = () if self.lie == "hides" else tuple(map(moved, said.statements))
            return encode(replace(said, statements=words))
        if isinstance(said, Statements) and self.lie == "moves":
            return encode(replace(said, statements=tuple(map(moved, said.statements))))
        return data


def moved(said: Statement) -> Statement:
    if {said.robot, said.other} != {"r1", "r2"}:
        return said
    evidence = replace(said.evidence, T_a_b=said.evidence.T_a_b @ SE2(3.0, 0.0, 0.0))
    return replace(said, stance=Stance.ACK, evidence=evidence, holds=NO_DIGEST)
