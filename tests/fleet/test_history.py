"""What is kept of the versions of a map."""

from __future__ import annotations

import numpy as np

from agent.fleet.history import History
from protocol.grid import FREE, OCCUPIED, OccupancyGrid
from protocol.tiles import TileMap


def version(number: int) -> TileMap:
    """A map of nine tiles that differs from other versions in the first."""
    cells = np.full((192, 192), FREE, np.int8)
    cells[number, 0] = OCCUPIED
    return TileMap.of(OccupancyGrid(cells, 0.05))


def test_the_oldest_version_gives_way_but_not_the_one_that_is_needed() -> None:
    history, versions = History(2), [version(number) for number in range(4)]
    for tiles in versions:
        history.add(tiles, needed=versions[0].digest)
    assert history.digests() == [versions[0].digest, versions[3].digest]
    assert history.newest == versions[3] and history.get(versions[1].digest) is None


def test_tiles_that_did_not_change_are_held_once() -> None:
    history = History(64)
    kept = [history.add(version(number)) for number in range(10)]
    assert kept == [version(number) for number in range(10)]
    assert [one.digest for one in kept] == history.digests()
    assert len({id(tile) for tiles in kept for tile in tiles.tiles.values()}) == 9 + 9
