"""Answers that are made once for all who ask, and the pieces of the large ones."""

from __future__ import annotations

import numpy as np

from agent.fleet.answers import Answers
from protocol.codec import decode
from protocol.grid import OccupancyGrid
from protocol.messages import Chunk, GlobalTiles, Manifest
from protocol.tiles import TileDelta, TileMap


def test_an_answer_whose_pieces_gave_way_is_made_again() -> None:
    answers, rng = Answers("r0", 1), np.random.default_rng(1)

    def large() -> GlobalTiles:
        cells = rng.choice(np.array([-1, 0, 100], np.int8), (400, 400))
        return GlobalTiles("r0", 1, TileDelta.between(None, TileMap.of(OccupancyGrid(cells, 0.05))))

    first = large()
    answers.kept("first", lambda: first)
    for other in range(20):
        answers.kept(other, large)
    manifest = decode(answers.kept("first", lambda: first))
    assert isinstance(manifest, Manifest)
    pieces = [decode(answers.chunk(manifest.digest, i) or b"") for i in range(manifest.chunks)]
    assert sum(len(piece.data) for piece in pieces if isinstance(piece, Chunk)) == manifest.size_bytes
