"""Circles that a piece of wall may be part of: those through three of its cells, the most promising of them.

A hypothesis counts the cells on it less those beside it.  Pieces lie one behind the other in flat arrays: a map has a hundred
small ones, and numpy asks as much for ten numbers as for a thousand.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

MIN_RADIUS_M, MAX_RADIUS_M = 0.15, 15.0
MIN_LENGTH_M = 0.7  # of wall on the circle
MIN_DENSITY = 0.6  # cells on the arc per cell of its length
MAX_CLUTTER = 0.3  # cells beside the arc, per cell on it
HYPOTHESES = 40  # a piece; three cells on a half-explained circle are found with p > 0.99
REACHES_M = (0.5, 1.2, 3.0)  # how far apart the three cells may lie: pillars, columns, rotundas
TRIES = 2  # of the hypotheses, refined
MAX_PIECE_CELLS = 600

_INDEX_BITS = 10  # of a draw, that number a piece's cells
_NO_DRAW = np.uint32(0xFFFFFFFF)


def _draws() -> tuple[NDArray[np.float64], NDArray[np.uint32]]:
    """The same lots for every piece: which cell comes first, and in which order the others are drawn.

    A draw ends in the number of its cell, so that the smallest of some draws says whose it is.
    """
    rng = np.random.default_rng(0)
    lots = rng.integers(1 << (31 - _INDEX_BITS), size=(MAX_PIECE_CELLS, HYPOTHESES), dtype=np.uint32)
    numbers = np.arange(MAX_PIECE_CELLS, dtype=np.uint32)[:, None]
    return rng.random(HYPOTHESES), np.bitwise_or(np.left_shift(lots, np.uint32(_INDEX_BITS)), numbers)


_FIRST, _ORDER = _draws()


@dataclass(frozen=True, slots=True, eq=False)
class Pieces:
    """Connected pieces of wall, one behind the other, none without a cell and none with more than `MAX_PIECE_CELLS`."""

    points_m: NDArray[np.float64]  # (P, 2)
    sizes: NDArray[np.int64]  # (G,) cells of each
    wall_m: NDArray[np.float64]  # (G,) wall that one of its cells stands for
    cell_m: float

    @property
    def starts(self) -> NDArray[np.int64]:
        return np.cumsum(self.sizes) - self.sizes

    @property
    def tolerance_m(self) -> float:
        return tolerance_m(self.cell_m)


def tolerance_m(cell_m: float) -> float:
    """A cell's centre lies this near the wall that occupied it."""
    return 0.6 * cell_m + 0.02


def promising(pieces: Pieces) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The best hypotheses: (C,) their piece, ascending, and (C, 3) the circle, the better first."""
    circles = _through_three(pieces)
    of_point = np.repeat(np.arange(len(pieces.sizes)), pieces.sizes)
    x0, y0, radius = (circles[:, k].astype(np.float32)[of_point] for k in range(3))
    x, y = (pieces.points_m[:, k].astype(np.float32)[:, None] - centre for k, centre in enumerate((x0, y0)))
    off = np.abs(np.sqrt(x * x + y * y) - radius)
    on, near = (np.add.reduceat(off < k * pieces.tolerance_m, pieces.starts, axis=0, dtype=np.int32) for k in (1, 3))
    hits = on - MAX_CLUTTER * (near - on)
    best = np.argsort(-hits, axis=1, kind="stable")[:, :TRIES]
    enough = np.take_along_axis(hits, best, axis=1) * pieces.wall_m[:, None] >= MIN_LENGTH_M * MIN_DENSITY
    piece, rank = np.nonzero(enough)
    return piece, circles[piece, :, best[piece, rank]]


def _through_three(pieces: Pieces) -> NDArray[np.float64]:
    """(G, 3, HYPOTHESES) circles x, y, r through triples of nearby cells; nowhere near where there is none."""
    points, starts = pieces.points_m, pieces.starts
    of_point = np.repeat(np.arange(len(pieces.sizes)), pieces.sizes)
    first = (_FIRST[None] * pieces.sizes[:, None]).astype(np.int64)
    reach = np.asarray(REACHES_M)[np.arange(HYPOTHESES) % len(REACHES_M)]
    x, y = (points.T[:, :, None] - points[starts[:, None] + first].transpose(2, 0, 1)[:, of_point]).astype(np.float32)
    near = x * x + y * y <= (reach * reach).astype(np.float32)
    lots = np.where(near, _ORDER[np.arange(len(points)) - starts[of_point]], _NO_DRAW)
    column = np.arange(HYPOTHESES)[None]
    lots[starts[:, None] + first, column] = _NO_DRAW
    second = np.minimum.reduceat(lots, starts, axis=0)
    q = np.where(second != _NO_DRAW, second & ((1 << _INDEX_BITS) - 1), 0).astype(np.int64)
    lots[starts[:, None] + q, column] = _NO_DRAW
    third = np.minimum.reduceat(lots, starts, axis=0)
    r = np.where(third != _NO_DRAW, third & ((1 << _INDEX_BITS) - 1), 0).astype(np.int64)
    p, q, r = (points[starts[:, None] + rows] for rows in (first, q, r))
    return _circumcircles(p, q - p, r - p, third != _NO_DRAW)


def _circumcircles(
    p: NDArray[np.float64], u: NDArray[np.float64], v: NDArray[np.float64], valid: NDArray[np.bool_]
) -> NDArray[np.float64]:
    cross = 2 * (u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0])
    uu, vv = (u * u).sum(axis=-1), (v * v).sum(axis=-1)
    bent = np.abs(cross) > 1e-6
    safe = np.where(bent, cross, 1.0)
    x, y = (v[..., 1] * uu - u[..., 1] * vv) / safe, (u[..., 0] * vv - v[..., 0] * uu) / safe
    radius = np.hypot(x, y)
    fits = valid & bent & (radius >= MIN_RADIUS_M) & (radius <= MAX_RADIUS_M)
    circles = np.stack([p[..., 0] + x, p[..., 1] + y, radius], axis=1)
    return np.where(fits[:, None], circles, 1e9)
