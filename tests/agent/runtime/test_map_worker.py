"""The map worker remembers where loops were closed, for whoever looks."""

from __future__ import annotations

from dataclasses import replace
from typing import cast

from agent.mapping.estimate import MapEstimate
from agent.mapping.mapper import Mapper
from agent.mapping.options import MappingOptions
from agent.runtime.map_worker import MapWorker
from agent.runtime.sensing import Readings
from protocol.geometry import SE2


class Told:
    """A mapper that estimates what the test says."""

    def __init__(self) -> None:
        self.says = Mapper(MappingOptions(), seed=1).estimate()

    def estimate(self) -> MapEstimate:
        return self.says


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
