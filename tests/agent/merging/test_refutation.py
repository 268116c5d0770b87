"""Which hypotheses stay rivals: judged by grounds that are made up, at transforms ten metres apart."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from agent.features.snapshot import MapSnapshot
from agent.merging import refutation
from agent.merging.refutation import unrefuted
from agent.merging.result import MatchOptions
from agent.merging.verdict import Grounds
from protocol.grid import OccupancyGrid
from tests.agent.merging.test_verdict import GOOD

NOWHERE = MapSnapshot.of(OccupancyGrid.empty(0.1))
CLEAR = GOOD
UNSURE = replace(GOOD, factor=0.91)
REFUTED = replace(GOOD, factor=0.85, deep_doubt=0.1)


def kept(monkeypatch: pytest.MonkeyPatch, *hypotheses: tuple[float, Grounds]) -> list[int]:
    """Which of these scored hypotheses stay."""
    poses = np.array([(10.0 * i, 0.0, 0.0) for i in range(len(hypotheses))])

    def evidence(ours: Any, theirs: Any, asked: Any) -> SimpleNamespace:
        return SimpleNamespace(score_m=np.array([hypotheses[round(x / 10)][0] for x in asked[:, 0]]))

    def weighed(ours: Any, theirs: Any, asked: Any) -> tuple[Grounds]:
        return (hypotheses[round(asked[0, 0] / 10)][1],)

    monkeypatch.setattr(refutation, "evidence", evidence)
    monkeypatch.setattr(refutation, "weighed", weighed)
    return [round(x / 10) for x in unrefuted(NOWHERE, NOWHERE, poses, MatchOptions())[:, 0]]


def test_the_grounds_are_what_they_are_called() -> None:
    assert CLEAR.is_clear(MatchOptions())
    assert not UNSURE.is_clear(MatchOptions())
    assert not UNSURE.is_refuted
    assert REFUTED.is_refuted


def test_what_refutes_itself_is_no_rival_of_what_raises_no_doubt(monkeypatch: pytest.MonkeyPatch) -> None:
    assert kept(monkeypatch, (20.0, CLEAR), (18.0, REFUTED), (5.0, UNSURE)) == [0, 2]
    assert kept(monkeypatch, (22.0, REFUTED), (20.0, CLEAR), (18.0, REFUTED)) == [1]


def test_a_rival_that_is_only_doubtful_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    assert kept(monkeypatch, (20.0, CLEAR), (18.0, UNSURE), (17.0, REFUTED)) == [0, 1]


def test_nothing_is_left_out_where_the_best_is_doubtful(monkeypatch: pytest.MonkeyPatch) -> None:
    assert kept(monkeypatch, (20.0, UNSURE), (18.0, REFUTED)) == [0, 1]
    assert kept(monkeypatch, (22.0, REFUTED), (20.0, UNSURE), (19.0, CLEAR)) == [0, 1, 2]
    assert kept(monkeypatch, (22.0, REFUTED), (20.0, replace(CLEAR, distinct_m=3.0))) == [0, 1]  # long walls alone


def test_a_hypothesis_far_behind_does_not_win_by_the_others_faults(monkeypatch: pytest.MonkeyPatch) -> None:
    assert kept(monkeypatch, (40.0, REFUTED), (20.0, CLEAR)) == [0, 1]
