"""Stories of fleets: real processes, simulated devices behind ptys, real Zenoh on loopback."""

from __future__ import annotations

import signal
from collections.abc import Iterator

import pytest

from agent.commands.demo_figures import agreement, aligned
from agent.commands.demo_stage import Stage
from agent.map_files import save_map
from protocol.geometry import SE2
from tests.harness.fleet import Fleet
from tests.harness.waiting import slowness

MERGE_WITHIN_S = 50.0


@pytest.fixture
def fleet() -> Iterator[Fleet]:
    with Fleet() as running:
        yield running


def test_two_robots_agree_on_one_map_and_a_late_joiner_gets_it_whole(fleet: Fleet) -> None:
    stage = fleet.stage("office", robots=3)
    for actor in stage.robots[:2]:
        fleet.start(actor)
    fleet.begin(stage)
    fleet.until(lambda: fleet.agree("robot-1", "robot-2"), MERGE_WITHIN_S, "one map of both")
    check_against_the_world(fleet, stage, "robot-1", "robot-2")
    fleet.start(stage.robots[2])
    fleet.until(lambda: fleet.agree("robot-1", "robot-2", "robot-3"), MERGE_WITHIN_S, "one map of all three")


def check_against_the_world(fleet: Fleet, stage: Stage, *robots: str) -> None:
    """The global map is the world, and every robot knows where it is in it."""
    fused, status = fleet.agents[robots[0]].grid(), fleet.status(robots[0])
    truth, start = stage.truth(), stage.start_pose(status["root"])
    assert fused is not None and truth is not None and start is not None
    T_world_global = aligned(fused, truth, start)
    assert agreement(fused, truth, T_world_global) > 0.98
    for robot in robots:
        own = fleet.status(robot)
        was = stage.pose_at(robot, own["mapping"]["pose_stamp_s"])
        believed = T_world_global @ SE2(*own["frames"][robot]) @ SE2(*own["mapping"]["pose"])
        assert was is not None
        assert was.distance_m(believed) < 0.3  # on a busy machine stamps are late: the place is what is claimed here


def test_a_robot_killed_and_started_again_finds_itself_in_its_own_map_and_merges_again(fleet: Fleet) -> None:
    stage = fleet.stage("office", robots=2)
    for actor in stage.robots:
        fleet.start(actor)
    fleet.begin(stage)
    fleet.until(lambda: fleet.agree("robot-1", "robot-2"), MERGE_WITHIN_S, "one map of both")
    before = fleet.status("robot-2")
    fleet.agents["robot-2"].ask("save")
    fleet.agents["robot-2"].kill()
    fleet.start(stage.robots[1])
    fleet.until(lambda: fleet.status("robot-2")["mapping"].get("status") == "tracking", 20.0, "finding itself")
    after = fleet.status("robot-2")
    assert after["boot"] != before["boot"]
    assert "restored the local map of the last run" in fleet.agents["robot-2"].log_tail(1000)
    is_same_map = after["mapping"]["epoch"] == before["mapping"]["epoch"]  # driven off the map meanwhile, it begins a new one
    assert not is_same_map or after["mapping"]["known_m2"] > 0.95 * before["mapping"]["known_m2"]
    fleet.until(lambda: fleet.agree("robot-1", "robot-2"), MERGE_WITHIN_S, "one map again")
    check_against_the_world(fleet, stage, "robot-1", "robot-2")


def test_robots_in_two_buildings_never_merge(fleet: Fleet) -> None:
    here, there = fleet.stage("office", robots=1, seed=1, prefix="here"), fleet.stage("office", robots=1, seed=2, prefix="there")
    fleet.start(here.robots[0])
    fleet.start(there.robots[0])
    fleet.begin(here)
    fleet.begin(there)
    enough = 45.0  # square metres known to each: plenty of corridor and corners to be fooled by
    fleet.until(lambda: all(fleet.status(r)["mapping"].get("known_m2", 0) > enough for r in fleet.agents), 40.0, "enough map")
    fleet.until(lambda: fleet.status("here-1")["attempts"] or fleet.status("there-1")["attempts"], 20.0, "an attempt")
    fleet.stays(lambda: not fleet.status("here-1")["group"] and not fleet.status("there-1")["group"], 3.0, "two maps")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_robot_stops_cleanly_within_two_seconds(fleet: Fleet, number: signal.Signals) -> None:
    stage = fleet.stage("office", robots=1)
    agent = fleet.start(stage.robots[0])
    fleet.until(lambda: fleet.status("robot-1")["mapping"]["scans"] > 3, 10.0, "a few scans")
    within_s = 2.0 * slowness()  # for a stop is processor time; `tests.campaigns.signals` has the figure
    agent.signal(number)
    assert agent.process.wait(within_s) == 0
    assert "Traceback" not in agent.log_tail(1000)


def test_a_robot_finds_itself_in_a_given_map(fleet: Fleet) -> None:
    stage = fleet.stage("office", robots=1)
    truth, start = stage.truth(), stage.start_pose("robot-1")
    assert truth is not None and start is not None
    save_map(truth, fleet.folder / "office")
    fleet.start(stage.robots[0], arguments=["--prior", str(fleet.folder / "office.yaml")])
    fleet.begin(stage)
    fleet.until(lambda: "robot-1-prior1" in fleet.members("robot-1"), MERGE_WITHIN_S, "localization")
    status = fleet.status("robot-1")
    assert status["root"] == "robot-1-prior1"  # the given map's frame is the fleet's
    assert SE2(*status["frames"]["robot-1"]).distance_m(start) < 0.15
