"""Stories of bad networks and bad neighbours: what is cut heals, what lies is not believed."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from agent.runtime.exchange import Exchange
from agent.runtime.network import NetworkSettings
from protocol.channels import robot_key
from tests.harness.fleet import Fleet

MERGE_WITHIN_S = 50.0
HEAL_WITHIN_S = 15.0  # the dialling side retries every second or so, then one beat, then one pull


@pytest.fixture
def fleet() -> Iterator[Fleet]:
    with Fleet() as running:
        yield running


def test_a_partition_heals_and_what_was_mapped_meanwhile_arrives(fleet: Fleet) -> None:
    stage = fleet.stage("office", robots=2)
    router, network = fleet.router(), fleet.network()
    cables = {actor.name: network.cable(router) for actor in stage.robots}
    for actor in stage.robots:
        fleet.start(actor, connect=[cables[actor.name].locator], arguments=["--profile", "infrastructure"])
    fleet.begin(stage)
    fleet.until(lambda: fleet.agree("robot-1", "robot-2"), MERGE_WITHIN_S, "one map through the router")
    known_m2 = fleet.status("robot-2")["mapping"]["known_m2"]
    before = fleet.global_digest("robot-1")
    network.set(cables["robot-2"], "hole")
    fleet.until(lambda: fleet.status("robot-2")["mapping"]["known_m2"] > known_m2 + 2.0, 30.0, "mapping goes on while cut off")
    assert fleet.members("robot-2") == ["robot-1", "robot-2"]  # silence is no reason to forget a map
    network.set(cables["robot-2"], "pass")
    fleet.until(
        lambda: fleet.agree("robot-1", "robot-2") and fleet.global_digest("robot-1") != before, HEAL_WITHIN_S, "one newer map"
    )
    assert fleet.status("robot-1")["global"]["known_m2"] > 0


def test_a_robot_maps_on_its_own_until_its_router_comes(fleet: Fleet) -> None:
    stage = fleet.stage("office", robots=1)
    network = fleet.network()
    cable = network.cable(fleet.router())
    network.set(cable, "cut")
    fleet.start(stage.robots[0], connect=[cable.locator], arguments=["--profile", "infrastructure"])
    fleet.until(lambda: fleet.status("robot-1")["mapping"]["scans"] > 3, 10.0, "mapping alone")
    assert any("no router answers" in problem for problem in fleet.status("robot-1")["problems"])
    network.set(cable, "pass")
    fleet.until(lambda: fleet.status("robot-1")["network"]["links"], 10.0, "a link to the router")


def test_a_hostile_peer_changes_nobodys_map(fleet: Fleet) -> None:
    stage = fleet.stage("office", robots=2)
    first = fleet.start(stage.robots[0])
    fleet.start(stage.robots[1])
    settings = NetworkSettings("evil", fleet=fleet.name, connect=tuple(first.ready["locators"]))
    lies = [b"", bytes(20_000), b"MQ\x01\x02" + b"\xff" * 500, b"MQ\x01\x03\x00\x00\x00\x00\xdf\xff\xff\xff\xff"]
    with Exchange(settings, lambda _: bytes(30_000)) as evil:
        fleet.begin(stage)

        def lie() -> bool:
            for victim in ("evil", "robot-1", "robot-2"):
                for register in ("hello", "beat", "map/feat", "edge/robot-1", "global/meta"):
                    for payload in lies:
                        evil.put(robot_key(fleet.name, victim, register), payload)
            return fleet.agree("robot-1", "robot-2")

        fleet.until(lie, MERGE_WITHIN_S, "one map of the honest robots")
    for robot in ("robot-1", "robot-2"):
        status = fleet.status(robot)
        assert [worker for worker in status["workers"] if worker["errors"]] == []
        assert status["mapping"]["scans_lost"] <= 0.05 * status["mapping"]["scans"] + 5
