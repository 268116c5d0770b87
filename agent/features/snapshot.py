"""One state of one map with everything that matching derives from it, each part made when first asked for and then kept.

The derived parts live in the *grid frame* (see `working.py`), so a map whose origin moves keeps them all.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from agent.features.corners import Corners, corners_of
from agent.features.directions import direction_spectrum
from agent.features.extraction import feature_map
from agent.features.field import UNKNOWN_BYTE, MatchField
from agent.features.incremental import Change, updated_field, updated_walls
from agent.features.lines import WallLines, wall_lines
from agent.features.round_walls import ArcsOfPieces
from agent.features.signatures import MAX_DENSE_TARGETS, MAX_TARGETS, Signatures, signatures_of
from agent.features.structure import structure_kinds
from agent.features.wall_points import WallPoints, wall_points
from agent.features.working import WorkingGrid
from protocol.features import FeatureMap
from protocol.grid import OccupancyGrid

T = TypeVar("T")


class MapSnapshot:
    """A grid and its cached features.  Never changes: `updated` makes another."""

    def __init__(self, grid: OccupancyGrid) -> None:
        self.grid = grid
        self._kept: dict[Hashable, Any] = {}
        self._arcs: ArcsOfPieces = {}

    @staticmethod
    def of(grid: OccupancyGrid) -> MapSnapshot:
        return MapSnapshot(grid)

    def updated(self, grid: OccupancyGrid) -> MapSnapshot:
        """The snapshot of a later state of the same map: what did not change is not fitted again."""
        later = MapSnapshot(grid)
        later._arcs = dict(self._arcs)
        if "walls" in self.__dict__:
            change = Change.between(self.grid, self.working, grid, later.working)
            walls = later.__dict__["walls"] = updated_walls(change, self.working, self.walls, later.working)
            if "field" in self.__dict__:
                later.__dict__["field"] = updated_field(change, self.field, self.walls, later.working, walls)
        return later

    def kept(self, key: Hashable, make: Callable[[MapSnapshot], T]) -> T:
        """What `make` derives from this snapshot, made once: rooms above keep their own views of a map here."""
        if key not in self._kept:
            self._kept[key] = make(self)
        value: T = self._kept[key]
        return value

    @property
    def middle_m(self) -> NDArray[np.float64]:
        """(2,) middle of the grid, grid frame."""
        height, width = self.working.free.shape
        return np.array([width, height]) * (self.working.resolution_m / 2)

    @cached_property
    def working(self) -> WorkingGrid:
        return WorkingGrid.of(self.grid)

    @cached_property
    def walls(self) -> WallPoints:
        """Every surface cell as an oriented point."""
        return wall_points(self.working)

    @cached_property
    def thin_walls(self) -> WallPoints:
        """One oriented point every 20 cm of wall."""
        return self.walls.subset(self.walls.thin)

    @cached_property
    def kinds(self) -> NDArray[np.uint8]:
        """(N,) what every surface cell is part of: `agent.features.structure`."""
        return structure_kinds(self.working, self.walls, self.lines.support_m)

    @cached_property
    def thin_kinds(self) -> NDArray[np.uint8]:
        """The same for `thin_walls`."""
        return self.kinds[self.walls.thin]

    @cached_property
    def field(self) -> MatchField:
        return MatchField.of(self.working, self.walls)

    @cached_property
    def lines(self) -> WallLines:
        return wall_lines(self.walls, self.working.resolution_m)

    @cached_property
    def corners(self) -> Corners:
        return corners_of(self.lines)

    @cached_property
    def directions(self) -> NDArray[np.complex128]:
        """Fourier transform of the histogram of wall directions."""
        return direction_spectrum(self.lines)

    @cached_property
    def signatures(self) -> Signatures:
        """Of the most telling wall points."""
        return self._signatures(MAX_TARGETS)

    @cached_property
    def dense_signatures(self) -> Signatures:
        """Of all firm wall points, for a small map that may lie anywhere."""
        return self._signatures(MAX_DENSE_TARGETS)

    @cached_property
    def features(self) -> FeatureMap:
        """What travels and what a person can read."""
        return feature_map(self.working, self.walls, self.lines, self.grid.origin, self._arcs)

    def _signatures(self, limit: int) -> Signatures:
        known = (self.field.fine != UNKNOWN_BYTE) | self.working.free.view(np.bool_)
        return signatures_of(self.thin_walls, self.thin_kinds, self.field.distance_m, known, self.working.resolution_m, limit)
