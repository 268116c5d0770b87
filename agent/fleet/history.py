"""The newest versions of one tile map, so that only differences need to travel."""

from __future__ import annotations

from collections import OrderedDict

from protocol.tiles import TileMap


class History:
    """By digest, oldest first; at most `kept` of them."""

    def __init__(self, kept: int) -> None:
        self._kept = kept
        self._maps: OrderedDict[bytes, TileMap] = OrderedDict()

    def add(self, tiles: TileMap, needed: bytes = b"") -> TileMap:
        """Keep one more, here as it is kept; the one that is needed goes last."""
        if self.newest is not None:
            tiles = tiles.sharing(self.newest)
        for digest in (needed, tiles.digest):
            if digest in self._maps:
                self._maps.move_to_end(digest)
        self._maps[tiles.digest] = tiles
        while len(self._maps) > self._kept:
            self._maps.popitem(last=False)
        return tiles

    def get(self, digest: bytes) -> TileMap | None:
        return self._maps.get(digest)

    @property
    def newest(self) -> TileMap | None:
        return next(reversed(self._maps.values())) if self._maps else None

    def digests(self) -> list[bytes]:
        return list(self._maps)
