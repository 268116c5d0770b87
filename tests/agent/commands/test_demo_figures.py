"""What the demo says in the end."""

from __future__ import annotations

from pathlib import Path

from agent.commands.demo_figures import Figures
from agent.commands.demo_stage import MERGE_WITHIN_S, open_stage


def of(robots: int) -> Figures:
    names = [f"robot-{k + 1}" for k in range(robots)]
    factors = [0.99 - 0.001 * k for k in range(robots)]
    return Figures(names, names, 12.0, factors, 200.0, 58, 0.999, {name: 0.01 * (k + 1) for k, name in enumerate(names)})


def test_of_a_few_robots_every_figure_is_told() -> None:
    said = of(3).sentence()
    assert "match factors 0.990, 0.989, 0.988" in said
    assert "robot-1 1.0 cm, robot-2 2.0 cm, robot-3 3.0 cm" in said


def test_of_many_robots_the_least_and_the_most() -> None:
    said = of(20).sentence()
    assert "20 match factors from 0.971 to 0.990" in said
    assert "pose errors 10.5 cm in the middle, at most 20.0 cm (robot-20)" in said


def test_robots_that_did_not_all_meet_are_named() -> None:
    assert Figures(["a", "b", "c"], ["a", "b"], None, [], 1.0, 0, None).sentence() == (
        "not merged: of 3 robots only a, b found out how their maps fit"
    )


def test_many_robots_on_one_computer_get_more_time_to_meet(tmp_path: Path) -> None:
    assert open_stage("office", 3, 0, tmp_path).time_limit_s() == MERGE_WITHIN_S
    assert open_stage("office", 20, 0, tmp_path).time_limit_s() > 2 * MERGE_WITHIN_S
