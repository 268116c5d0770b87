"""The map worker remembers where loops were closed, for whoever looks."""

from __future__ import annotations

from dataclasses import replace
from typing import cast

import numpy as np

from agent.mapping.estimate import MapEstimate, MapperStatus, ScanOutcome
from agent.mapping.mapper import Mapper
from agent.mapping.options import MappingOptions
from agent.mapping.wheel_check import WheelFigures
from agent.runtime.map_worker import MapWorker
from agent.runtime.problems import HELD_SCANS, mapping_problems
from agent.runtime.sensing import Readings
from agent.runtime.snapshot import wheels
from hw.readings import LaserScan
from protocol.geometry import SE2


class Told:
    """A mapper that estimates what the test says."""

    def __init__(self) -> None:
        self.says = Mapper(MappingOptions(), seed=1).estimate()

    def estimate(self) -> MapEstimate:
        return self.says

    def add_scan(self, scan: LaserScan) -> ScanOutcome:
        return ScanOutcome(self.says.status, SE2.identity(), False, 0.3, "only 30% of the scan fits the map")


def test_a_closed_loop_is_marked_where_the_robot_was_and_forgotten_with_its_map() -> None:
    mapper = Told()
    worker = MapWorker(cast(Mapper, mapper), Readings())
    worker.publish()
    worker.publish()
    assert not worker.loop_places
    mapper.says = replace(mapper.says, loops_closed=1, T_map_robot=SE2(3.0, 4.0, 0.5))
    worker.publish()
    worker.publish()
    assert list(worker.loop_places) == [SE2(3.0, 4.0, 0.5)]
    mapper.says = replace(mapper.says, epoch=mapper.says.epoch + 1)
    worker.publish()
    assert not worker.loop_places


def test_scans_that_are_not_believed_are_a_problem_until_one_is() -> None:
    mapper, readings = Told(), Readings()
    worker = MapWorker(cast(Mapper, mapper), readings)
    for status, n, said in ((MapperStatus.LOST, HELD_SCANS - 1, 0), (MapperStatus.LOST, 1, 1), (MapperStatus.TRACKING, 1, 0)):
        mapper.says = replace(mapper.says, status=status)
        for _ in range(n):
            readings.put(LaserScan(0.0, np.ones(4, np.float32), np.zeros(4, np.float32), 0.05, 12.0))
            worker.step()
        assert len(mapping_problems(worker)) == said
        assert all("nothing is drawn: only 30%" in sentence for sentence in mapping_problems(worker))


def test_wheels_that_tell_something_else_and_scans_that_do_not_fit_are_problems() -> None:
    mapper = Told()
    worker = MapWorker(cast(Mapper, mapper), Readings())
    figures = WheelFigures(0.0, 0.001, 0.08, 0.002, 0.0, 0.001, 0.02, 99)
    mapper.says = replace(mapper.says, wheels=figures)
    worker.publish()
    (sentence,) = mapping_problems(worker)
    assert "8% smaller turns" in sentence
    assert wheels(figures) == {
        "length_percent": 0.0, "length_error_percent": 0.1, "turn_percent": 8.0, "turn_error_percent": 0.2,
        "drift_deg_m": 0.0, "drift_error_deg_m": 0.06, "slip_deg": 1.15, "stretches": 99.0,
    }  # fmt: skip
    mapper.says = replace(mapper.says, wheels=None, usual_fraction=0.52)
    worker.publish()
    (sentence,) = mapping_problems(worker)
    assert "52% of them lies on its walls" in sentence
