"""What this robot publishes about its own map, ready to be pulled: announcement, coarse map, cells since any recent version."""

from __future__ import annotations

import hashlib
from collections import OrderedDict

import numpy as np

from agent.fleet.consistency import coarsened
from protocol.channels import CHUNK_BYTES, MAX_PUSH_BYTES
from protocol.codec import encode
from protocol.features import FeatureMap
from protocol.grid import OccupancyGrid
from protocol.messages import Chunk, CoarseMap, FineTiles, GlobalTiles, Manifest, MapAnnouncement, MapVersion, Message
from protocol.tiles import TileDelta, TileMap

COARSE_M = 0.20
_KEPT_VERSIONS = 12  # of a map: a peer slower than these pulls everything anew
_KEPT_BLOBS = 16
_KEPT_ANSWERS = 32


class Blobs:
    """Answers larger than one push, by their hash, until newer ones need the room."""

    def __init__(self, robot: str, boot: int) -> None:
        self._robot, self._boot = robot, boot
        self._blobs: OrderedDict[bytes, bytes] = OrderedDict()

    def answer(self, message: Message) -> bytes:
        """The message itself, or the manifest of its pieces."""
        data = encode(message)
        if len(data) <= MAX_PUSH_BYTES:
            return data
        digest = hashlib.sha256(data).digest()
        self._blobs[digest] = data
        self._blobs.move_to_end(digest)
        while len(self._blobs) > _KEPT_BLOBS:
            self._blobs.popitem(last=False)
        return encode(Manifest(self._robot, self._boot, digest, len(data), CHUNK_BYTES))

    def chunk(self, digest: bytes, index: int) -> bytes | None:
        data = self._blobs.get(digest)
        if data is None or not 0 <= index * CHUNK_BYTES < len(data):
            return None
        piece = data[index * CHUNK_BYTES : (index + 1) * CHUNK_BYTES]
        return encode(Chunk(self._robot, self._boot, digest, index, piece))


class History:
    """The newest versions of one tile map, so that only differences need to travel."""

    def __init__(self, kept: int = _KEPT_VERSIONS) -> None:
        self._kept = kept
        self._maps: OrderedDict[bytes, TileMap] = OrderedDict()

    def add(self, tiles: TileMap, needed: bytes = b"") -> None:
        """Keep one more; the one that is needed goes last."""
        for digest in (needed, tiles.digest):
            if digest in self._maps:
                self._maps.move_to_end(digest)
        self._maps[tiles.digest] = tiles
        while len(self._maps) > self._kept:
            self._maps.popitem(last=False)

    def get(self, digest: bytes) -> TileMap | None:
        return self._maps.get(digest)

    @property
    def newest(self) -> TileMap | None:
        return next(reversed(self._maps.values())) if self._maps else None

    def digests(self) -> list[bytes]:
        return list(self._maps)


_MAX_ROWS = {"lines": (600, 3), "circles": (50, 2), "arcs": (50, 2), "curves": (150, 3)}  # how many, and the column of the size


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
        self.blobs = Blobs(robot, boot)
        self._history = History()
        self._versions: dict[bytes, MapVersion] = {}  # of everything in the history
        self._answers: OrderedDict[tuple[str, bytes, bytes], bytes] = OrderedDict()
        self._coarse: CoarseMap | None = None
        self._counted_bytes = self._counted_tiles = 0

    def publish(self, grid: OccupancyGrid, features: FeatureMap, frame: int, first_revision: int = 1) -> bool:
        """Take a new state of the map; False when no cell differs from what is published already."""
        is_same_frame = self.version is not None and self.version.frame == frame
        tiles = TileMap.of(grid, self.tiles if is_same_frame else None)
        if self.version is not None and is_same_frame and tiles.digest == self.version.digest:
            return False
        revision = self.version.revision + 1 if self.version is not None and is_same_frame else first_revision
        self.version = MapVersion(frame, revision, tiles.digest)
        self.tiles, self.grid, self._coarse = tiles, tiles.grid(), None
        self.known_area_m2 = self.grid.known_area_m2()
        self._history.add(tiles, needed=self.pinned)
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
        key = ("fine", old.digest if old else b"", wanted.digest)
        if key not in self._answers:
            delta = TileDelta.between(old, wanted)
            self._keep(key, self.blobs.answer(FineTiles(self.robot, self.boot, version, delta)))
        return self._answers[key]

    def global_tiles(self, history: History, base: bytes, target: bytes) -> bytes | None:
        """The encoded difference between two global maps we hold."""
        wanted = history.get(target) if target else history.newest
        if wanted is None:
            return None
        old = history.get(base) if base else None
        key = ("global", old.digest if old else b"", wanted.digest)
        if key not in self._answers:
            delta = TileDelta.between(old, wanted)
            self._keep(key, self.blobs.answer(GlobalTiles(self.robot, self.boot, delta)))
        return self._answers[key]

    def _keep(self, key: tuple[str, bytes, bytes], answer: bytes) -> None:
        self._answers[key] = answer
        while len(self._answers) > _KEPT_ANSWERS:
            self._answers.popitem(last=False)

    def _estimated_fine_bytes(self) -> int:
        """About what the whole map costs; counted anew only when the number of tiles has changed by a fifth."""
        assert self.tiles is not None
        tiles = len(self.tiles.tiles)
        if self._counted_bytes == 0 or abs(tiles - self._counted_tiles) > 0.2 * self._counted_tiles:
            self._counted_bytes, self._counted_tiles = len(TileDelta.between(None, self.tiles).payload), tiles
        return self._counted_bytes
