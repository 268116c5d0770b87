"""The merging engine, asked whether one stretch of a robot's path lies in another: the paper's use of it for loops."""

from __future__ import annotations

from agent.features.snapshot import MapSnapshot
from agent.merging.localization import localize
from protocol.geometry import SE2
from protocol.grid import OccupancyGrid


def fit_in_own_map(local: OccupancyGrid, given: OccupancyGrid) -> SE2 | None:
    """T_given_local where the engine would merge the two, else None (`agent.mapping.loop_closure.FitMaps`)."""
    result = localize(MapSnapshot.of(local), MapSnapshot.of(given))
    return result.T_ours_theirs if result.accepted else None
