"""Wheels that do not tell what the scans show are noticed, and the sentence says what to set."""

from __future__ import annotations

import math

import numpy as np
import pytest

from agent.mapping.mapper import Mapper
from agent.mapping.options import MappingOptions
from agent.mapping.wheel_check import FEWEST_STRETCHES, WheelCheck, WheelFigures
from hw.readings import Odometry
from protocol.geometry import SE2
from tests.agent.mapping.worlds import ROOMS, rounds, scan_at


def shown(length: float = 1.0, turn: float = 1.0, drift_deg_m: float = 0.0, slip_deg: float = 0.0) -> WheelFigures:
    """After 225 metres on wheels that tell this many metres and radians per true one."""
    check, rng = WheelCheck(), np.random.default_rng(2)
    for k in range(4500):
        told = SE2(0.05, 0.0, 0.3 if k % 60 < 8 else 0.0)
        drift_rad = math.radians(0.05 * drift_deg_m + math.sqrt(0.05) * slip_deg * rng.standard_normal())
        true = SE2(0.05 / length, 0.0, told.theta_rad / turn + drift_rad + rng.normal(0.0, 0.002))
        check.add(told, told.inverse() @ true, is_open=False)
    figures = check.figures()
    assert figures is not None
    return figures


def said(figures: WheelFigures) -> str:
    return "\n".join(figures.sentences())


def test_true_wheels_are_not_spoken_of() -> None:
    assert said(shown()) == ""
    assert said(shown(length=1.02, turn=0.98, drift_deg_m=1.5, slip_deg=1.5)) == ""


def test_a_wrong_track_is_told_with_the_right_one() -> None:
    figures = shown(turn=1 / 1.08)
    assert figures.turn == pytest.approx(0.08, abs=4 * figures.turn_error)
    assert "8% smaller turns" in said(figures)
    assert "set wheels.track_m to 0.926 of what it is" in said(figures)


def test_a_wrong_wheel_radius_is_told_once_for_ways_and_turns() -> None:
    words = said(shown(length=1.06, turn=1.06))
    assert "6% longer ways" in words
    assert "set wheels.wheel_radius_m to 0.943 of what it is" in words
    assert "the right wheel radius corrects it, too" in words


def test_uneven_wheels_and_slip_are_told_apart() -> None:
    assert said(shown(drift_deg_m=8.0)).startswith("the robot bends 8 degrees a metre to the left")
    assert said(shown(drift_deg_m=-8.0)).startswith("the robot bends 8 degrees a metre to the right")
    figures = shown(slip_deg=5.0)
    assert math.degrees(figures.slip_rad) == pytest.approx(5.0, abs=0.6)
    assert said(figures).startswith("the wheels slip")


def test_nothing_is_said_too_soon_nor_of_lengths_in_a_corridor_without_features() -> None:
    check = WheelCheck()
    for k in range(2 * FEWEST_STRETCHES):
        assert check.figures() is None or k > FEWEST_STRETCHES
        check.add(SE2(1.0, 0.0, 0.0), SE2(0.0 if k % 2 else 0.1, 0.0, 0.0), is_open=k % 2 == 1)
    figures = check.figures()
    assert figures is not None
    assert figures.length == pytest.approx(0.1)


def test_a_mapper_finds_what_is_wrong_with_its_wheels_and_remembers_it() -> None:
    """Two rooms, wheels 6 % long and a track 8 % wide."""
    rng, mapper = np.random.default_rng(3), Mapper(MappingOptions(particles=3), seed=0)
    told, last = SE2.identity(), None
    for stamp_s, pose in rounds(60.0):
        step = pose if last is None else last.inverse() @ pose
        told, last = told @ SE2(1.06 * step.x_m, 0.0, 1.06 / 1.08 * step.theta_rad), pose
        mapper.add_odometry(Odometry(stamp_s, told.x_m, told.y_m, told.theta_rad))
        mapper.add_scan(scan_at(ROOMS, pose, stamp_s, rng, beams=90))
    figures = mapper.estimate().wheels
    assert figures is not None
    assert figures.length == pytest.approx(1 / 1.06 - 1, abs=0.01)
    assert figures.turn == pytest.approx(1.08 / 1.06 - 1, abs=0.02)
    assert Mapper.restore(mapper.checkpoint(), mapper.options).estimate().wheels == figures
