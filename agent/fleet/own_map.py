"""What this robot publishes about its own map, ready to be pulled: announcement, coarse map, cells since any recent version."""

from __future__ import annotations

import numpy as np

from agent.fleet.answers import Answers
from agent.fleet.history import History
from protocol.features import FeatureMap
from protocol.grid import UNKNOWN, OccupancyGrid
from protocol.messages import NO_DIGEST, CoarseMap, FineTiles, MapAnnouncement, MapVersion
from protocol.tiles import TileDelta, TileMap

COARSE_M = 0.20
_KEPT_VERSIONS = 64  # of a map, two minutes of one that grows: whoever composes on a busy machine may name one a minute old
_MAX_ROWS = {"lines": (600, 3), "circles": (50, 2), "arcs": (50, 2), "curves": (150, 3)}  # how many, and the column of the size


class OwnMap:
    """Our local map as peers see it."""

    def __init__(self, robot: str, boot: int, *, is_frozen: bool) -> None:
        self.robot, self.boot, self.is_frozen = robot, boot, is_frozen
        self.version: MapVersion | None = None
        self.tiles: TileMap | None = None
        self.grid: OccupancyGrid | None = None  # what peers can know of it: exactly `tiles.grid()`
        self.known_area_m2 = 0.0
        self.pinned = b""  # digest of the version that the composer's recipe uses: somebody may pull it yet
        self.announcement: MapAnnouncement | None = None
        self.answers = Answers(robot, boot)
        self._history = History(_KEPT_VERSIONS)
        self._versions: dict[bytes, MapVersion] = {}  # of everything in the history
        self._coarse: CoarseMap | None = None
        self._counted_bytes = self._counted_tiles = 0

    def publish(self, grid: OccupancyGrid, features: FeatureMap, frame: int) -> bool:
        """Take a new state of the map; False when no cell differs from what is published already."""
        is_same_frame = self.version is not None and self.version.frame == frame
        tiles = TileMap.of(grid, self.tiles if is_same_frame else None)
        if self.version is not None and is_same_frame and tiles.digest == self.version.digest:
            return False
        revision = self.version.revision + 1 if self.version is not None and is_same_frame else 1
        self.version = MapVersion(frame, revision, tiles.digest)
        self.tiles = self._history.add(tiles, needed=self.pinned)
        self.grid, self._coarse = tiles.grid(), None
        self.known_area_m2 = self.grid.known_area_m2()
        self._versions = {d: v for d, v in self._versions.items() if self._history.get(d)} | {tiles.digest: self.version}
        self.announcement = MapAnnouncement(
            self.robot,
            self.boot,
            self.version,
            grid.resolution_m,
            self.known_area_m2,
            self._estimated_fine_bytes(),
            trimmed(features),
            self.is_frozen,
        )
        return True

    def coarse(self) -> CoarseMap | None:
        if self._coarse is None and self.grid is not None and self.version is not None:
            self._coarse = CoarseMap(self.robot, self.boot, self.version, coarsened(self.grid, COARSE_M))
        return self._coarse

    def version_tiles(self, digest: bytes) -> TileMap | None:
        """One of the newest versions of our own map."""
        return self._history.get(digest)

    def fine(self, base: bytes, target: bytes) -> bytes | None:
        """The encoded difference; from nothing when the base is not remembered."""
        wanted = self._history.get(target) if target else self.tiles
        if wanted is None:
            return None
        version = self._versions[wanted.digest]
        old = self._history.get(base) if base else None
        name = ("fine", old.digest if old else NO_DIGEST, version)
        return self.answers.kept(name, lambda: FineTiles(self.robot, self.boot, version, TileDelta.between(old, wanted)))

    def _estimated_fine_bytes(self) -> int:
        """About what the whole map costs; counted anew only when the number of tiles has changed by a fifth."""
        assert self.tiles is not None
        tiles = len(self.tiles.tiles)
        if self._counted_bytes == 0 or abs(tiles - self._counted_tiles) > 0.2 * self._counted_tiles:
            self._counted_bytes, self._counted_tiles = len(TileDelta.between(None, self.tiles).payload), tiles
        return self._counted_bytes


def trimmed(features: FeatureMap) -> FeatureMap:
    """The largest features only: an announcement is one push, and a campus has thousands."""
    tables = {}
    for name, (limit, size_column) in _MAX_ROWS.items():
        table = getattr(features, name)
        if len(table) > limit:
            largest = np.sort(np.argsort(-table[:, size_column], kind="stable")[:limit])
            table = table[largest]
        tables[name] = table
    return FeatureMap(**tables)


def coarsened(grid: OccupancyGrid, resolution_m: float) -> OccupancyGrid:
    """The grid at about `resolution_m`: occupied where anything is, else free where anything is."""
    factor = max(1, round(resolution_m / grid.resolution_m))
    if factor == 1:
        return grid
    height, width = -(-grid.height // factor), -(-grid.width // factor)
    padded = np.full((height * factor, width * factor), UNKNOWN, np.int8)
    padded[: grid.height, : grid.width] = grid.cells
    return OccupancyGrid(padded.reshape(height, factor, width, factor).max(axis=(1, 3)), grid.resolution_m * factor, grid.origin)
