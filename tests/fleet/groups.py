"""Fleets of two to six robots in one world, as the coordinator's stories need them."""

from __future__ import annotations

from agent.fleet.options import FleetOptions
from protocol.geometry import SE2
from tests.fleet.explorer import Explorer, random_world
from tests.fleet.processes import Link, Node
from tests.fleet.simulation import Fleet

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
