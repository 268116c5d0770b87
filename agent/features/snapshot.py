"""One state of one map with everything that matching derives from it, each part made when first asked for and then kept.

The derived parts live in the *grid frame* (see `working.py`), so a map whose origin moves keeps them all.
"""

from __future__ import annotations

from functools import cached_property

from agent.features.working import WorkingGrid
from protocol.features import FeatureMap
from protocol.grid import OccupancyGrid


class MapSnapshot:
    """A grid and its cached features.  Never changes: `updated` makes another."""

    def __init__(self, grid: OccupancyGrid) -> None:
        self.grid = grid

    @staticmethod
    def of(grid: OccupancyGrid) -> MapSnapshot:
        return MapSnapshot(grid)

    def updated(self, grid: OccupancyGrid, changed: object = None) -> MapSnapshot:
        """The snapshot of a later state of the same map."""
        return MapSnapshot(grid)

    @cached_property
    def working(self) -> WorkingGrid:
        return WorkingGrid.of(self.grid)

    @cached_property
    def features(self) -> FeatureMap:
        """What travels and what a person can read."""
        return FeatureMap()
