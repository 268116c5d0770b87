"""Two robots' fleet logic over real Zenoh: they find out how their maps fit, and a stranger's bytes change nothing."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass

import pytest

from agent.features.snapshot import MapSnapshot
from agent.fleet.coordinator import Coordinator
from agent.fleet.options import FleetOptions
from agent.merging.result import MatchOptions
from agent.runtime.exchange import Exchange
from agent.runtime.fleet_worker import FleetWorker
from agent.runtime.merge_worker import MergeWorker
from agent.runtime.network import NetworkSettings
from agent.runtime.worker import Worker
from protocol.channels import robot_key
from protocol.geometry import SE2
from protocol.grid import OccupancyGrid
from tests.harness.floorplans import office
from tests.harness.waiting import until

FLEET = "test-fleet-worker"


@dataclass(frozen=True, slots=True)
class Still:
    """A robot that stands in a finished map."""

    grid: OccupancyGrid
    T_map_robot: SE2 = SE2(0.0, 0.0, 0.0)
    epoch: int = 0


def start(stack: contextlib.ExitStack, robot: str, grid: OccupancyGrid, connect: tuple[str, ...] = ()) -> FleetWorker:
    merger = MergeWorker(MatchOptions())
    coordinator = Coordinator(robot, 1 + hash(robot) % 1000, FleetOptions(beat_period_s=0.2, announce_period_s=0.2))
    fleet = FleetWorker(coordinator, NetworkSettings(robot, fleet=FLEET, connect=connect), merger)
    workers = [
        Worker("merge", merger.step, 60.0, "", ""),
        Worker("fleet", fleet.step, 5.0, "", ""),
        Worker("pull-bulk", fleet.bulk_step, 60.0, "", ""),
        Worker("pull-small", fleet.small_step, 60.0, "", ""),
    ]
    fleet.exchange.open()
    stack.callback(fleet.exchange.close)
    for worker in workers:
        worker.start()
        stack.callback(worker.join, 3.0)
    for worker in workers:
        stack.callback(worker.ask_to_stop)
    fleet.local_maps.put((Still(grid), MapSnapshot.of(grid).features))
    return fleet


WORLD = office(seed=3)
T_B_WORLD = SE2(4.0, -7.0, 2.1)  # nobody knows it: it is what they have to find
LEFT_M, RIGHT_M = (-1.0, 19.0), (8.0, 99.0)


@pytest.fixture
def stack() -> Iterator[contextlib.ExitStack]:
    with contextlib.ExitStack() as opened:
        yield opened


def start_pair(stack: contextlib.ExitStack) -> tuple[FleetWorker, FleetWorker]:
    a = start(stack, "a", WORLD.mapped(SE2.identity(), 0.05, LEFT_M))
    b = start(stack, "b", WORLD.mapped(T_B_WORLD, 0.05, RIGHT_M), connect=tuple(a.exchange.locators()))
    return a, b


def test_two_robots_hold_the_same_global_map(stack: contextlib.ExitStack) -> None:
    a, b = start_pair(stack)
    until(lambda: a.global_map is not None and b.global_map is not None and a.global_map.digest == b.global_map.digest, 30.0)
    assert a.global_map is not None
    assert [member.robot for member in a.global_map.members] == ["a", "b"]
    frames = a.state().frames
    T_a_b = frames["a"].T_global_map.inverse() @ frames["b"].T_global_map
    assert T_a_b.distance_m(T_B_WORLD.inverse()) < 0.1


def test_garbage_on_a_peers_keys_harms_nobody(stack: contextlib.ExitStack) -> None:
    stranger_says = [b"", b"\x00" * 100, b"MQ\x01\x02" + b"\xff" * 400, b"MQ\x01\x03\x00\x00\x00\x00\xdd\xff\xff\xff\xff"]
    a, b = start_pair(stack)
    stranger = stack.enter_context(
        Exchange(NetworkSettings("x", fleet=FLEET, connect=tuple(a.exchange.locators())), lambda _: b"?")
    )
    until(stranger.links)
    for register in ("hello", "beat", "map/feat", "edge/a", "global/meta"):
        for payload in stranger_says:
            stranger.put(robot_key(FLEET, "x", register), payload)
    until(lambda: a.global_map is not None and b.global_map is not None and a.global_map.digest == b.global_map.digest, 30.0)
    assert "x" not in a.state().frames
