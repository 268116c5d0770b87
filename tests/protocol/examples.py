"""One example of every kind of message: what the golden bytes, the laws and the fuzzer start from."""

from __future__ import annotations

import numpy as np

from protocol.features import FeatureMap
from protocol.geometry import SE2
from protocol.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from protocol.messages import (
    Beat,
    Chunk,
    CoarseMap,
    Estate,
    Evidence,
    FineTiles,
    GlobalMember,
    GlobalMeta,
    GlobalTiles,
    Hello,
    Manifest,
    MapAnnouncement,
    MapVersion,
    Message,
    Stance,
    Statement,
    Statements,
)
from protocol.tiles import TileDelta, TileMap

BOOT = 0x1122334455667788


def small_grid() -> OccupancyGrid:
    """A room of 3 m x 2 m with a door, at 10 cm."""
    cells = np.full((22, 32), UNKNOWN, np.int8)
    cells[1:21, 1:31] = OCCUPIED
    cells[2:20, 2:30] = FREE
    cells[10:13, 30] = FREE
    return OccupancyGrid(cells, 0.1, SE2(-1.2, 0.4, 0.0))


def versions() -> tuple[MapVersion, MapVersion]:
    tiles = TileMap.of(small_grid())
    return MapVersion(7, 3, tiles.digest), MapVersion(2**64 - 1, 12, bytes(range(16)))


def features() -> FeatureMap:
    return FeatureMap(
        lines=np.array([[1.5, -2.0, 0.5, 4.2, 0.01, 0.02], [-30.25, 7.125, -3.0, 1.0, 0.002, 0.005]], np.float32),
        circles=np.array([[0.5, 0.25, 0.4, 0.03]], np.float32),
        arcs=np.array([[3.0, 4.0, 2.0, -1.0, 1.5, 0.02]], np.float32),
        curves=np.array([[9.0, -8.0, 0.25, 2.5, 0.1]], np.float32),
    )


def evidence() -> Evidence:
    ours, theirs = versions()
    covariance = (0.01, 0.001, 0.0, 0.02, 0.0, 0.0003)
    return Evidence("amber", "birch", ours, theirs, "amber", SE2(1.5, -2.25, 0.75), covariance, 900, 40, 23.5, 31.25)


def examples() -> dict[str, Message]:
    """By the name of the channel."""
    ours, theirs = versions()
    head = ("amber", BOOT)
    whole = TileDelta.between(None, TileMap.of(small_grid()))
    statement = Statement(*head, 5, "birch", Stance.ACK, evidence(), bytes(range(8)), "matched")
    words = Statement("birch", BOOT + 1, 5, "amber", Stance.ACK, evidence(), bytes(range(8)), "matched")
    members = (
        GlobalMember("amber", ours, SE2.identity(), (0.0,) * 6),
        GlobalMember("birch", theirs, SE2(1.5, -2.25, 0.75), (0.01, 0.001, 0.0, 0.02, 0.0, 0.0003)),
    )
    meta = GlobalMeta(*head, 9, "amber", 0.05, members, (bytes(8),), bytes(range(16)), 12, 3456)
    return {
        "hello": Hello(*head, 12.5, 1, 1, "mapquilt 0.1", 0.05, False, ("tcp/10.0.0.7:7447",)),
        "beat": Beat(*head, 77, 80.25, 1.0, ours, bytes(range(8)), bytes(range(16)), SE2(1.0, 2.0, -0.5), False, 0.25, 42.5),
        "feat": MapAnnouncement(*head, ours, 0.05, 42.5, 2345, features()),
        "coarse": CoarseMap(*head, ours, small_grid()),
        "fine": FineTiles(*head, ours, whole),
        "edge": statement,
        "edges": Statements(*head, 5, (statement,)),
        "global": meta,
        "globaltiles": GlobalTiles(*head, whole),
        "estate": Estate(*head, "birch", BOOT + 1, False, (words,), ours, whole),
        "manifest": Manifest(*head, bytes(range(32)), 40_000, 16_000),
        "chunk": Chunk(*head, bytes(range(32)), 2, b"piece of a map"),
    }
