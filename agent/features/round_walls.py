"""Circles and arcs: round pieces of wall that no straight line explains, each with its uncertainty.

Every connected piece of wall is asked for its best arc (`circle_fits.py`); what that explains is erased, and the piece is
asked again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from agent.features.circle_fits import MIN_CELLS, best_arcs
from agent.features.circle_hypotheses import MAX_PIECE_CELLS, Pieces, tolerance_m
from protocol.features import ARC_COLUMNS, CIRCLE_COLUMNS

CIRCLE_SPAN_RAD = math.radians(290)  # seen from nearly all sides: a circle, not an arc
MAX_PIECES = 100  # the largest
MAX_PER_PIECE = 4
MAX_ARCS = 64


@dataclass(frozen=True, slots=True)
class Arc:
    """A circular piece of wall, counter-clockwise from `start_rad`."""

    x_m: float
    y_m: float
    radius_m: float
    start_rad: float
    span_rad: float
    sigma_m: float  # of centre and radius together: the largest of the three

    @property
    def is_circle(self) -> bool:
        return self.span_rad >= CIRCLE_SPAN_RAD

    def explains(self, points_m: NDArray[np.float64], resolution_m: float) -> NDArray[np.bool_]:
        """(N,) which of (N, 2) points are cells of this wall, or of its other side."""
        x, y = (points_m - (self.x_m, self.y_m)).T
        near: NDArray[np.bool_] = np.abs(np.sqrt(x * x + y * y) - self.radius_m) < 3 * tolerance_m(resolution_m)
        if not self.is_circle:
            rows = np.flatnonzero(near)
            near[rows] = np.remainder(np.arctan2(y[rows], x[rows]) - self.start_rad, math.tau) <= self.span_rad
        return near


ArcsOfPieces = dict[bytes, tuple[Arc, ...]]  # by the cells of the piece: from one second to the next most stay as they are


@dataclass(slots=True, eq=False)
class _Piece:
    points_m: NDArray[np.float64]  # those that no arc explains yet
    stride: int  # one of so many of its cells is looked at
    arcs: list[Arc] = field(default_factory=list)


def find_arcs(points_m: NDArray[np.float64], piece: NDArray[np.int64], resolution_m: float, known: ArcsOfPieces) -> list[Arc]:
    """Arcs among (N, 2) points, `piece[i]` numbering the connected piece that point i belongs to; the longest first.

    What is known of an earlier state of the map is not asked again, and left as it is known now.
    """
    pieces = {p.points_m.tobytes(): p for p in _largest(points_m, piece)}
    asked = [p for key, p in pieces.items() if key not in known]
    for _ in range(MAX_PER_PIECE):
        asked = [p for p in asked if len(p.points_m) >= MIN_CELLS]
        if not asked:
            break
        asked = _asked_once(asked, resolution_m)
    now = {key: known.get(key, tuple(p.arcs)) for key, p in pieces.items()}
    known.clear()
    known.update(now)
    return sorted((arc for arcs in now.values() for arc in arcs), key=lambda arc: -arc.radius_m * arc.span_rad)[:MAX_ARCS]


def _largest(points_m: NDArray[np.float64], piece: NDArray[np.int64]) -> list[_Piece]:
    sizes = np.bincount(piece) if len(piece) else np.zeros(0, np.int64)
    order = np.argsort(piece, kind="stable")
    starts = np.concatenate([[0], np.cumsum(sizes)])
    largest = [i for i in np.argsort(-sizes, kind="stable")[:MAX_PIECES].tolist() if sizes[i] >= MIN_CELLS]
    strides = [-(-int(sizes[i]) // MAX_PIECE_CELLS) for i in largest]
    return [_Piece(points_m[order[starts[i] : starts[i + 1] : n]], n) for i, n in zip(largest, strides, strict=True)]


def _asked_once(pieces: list[_Piece], cell_m: float) -> list[_Piece]:
    """Those pieces that had another arc, which is noted, and whose cells are erased."""
    sizes = np.array([len(p.points_m) for p in pieces])
    wall_m = cell_m * np.array([p.stride for p in pieces])
    numbers, rows = best_arcs(Pieces(np.concatenate([p.points_m for p in pieces]), sizes, wall_m, cell_m))
    found = [pieces[i] for i in numbers.tolist()]
    for p, (x, y, radius, start, span, sigma) in zip(found, rows.tolist(), strict=True):
        arc = Arc(x, y, radius, math.remainder(start, math.tau), span, sigma)
        p.arcs.append(arc)
        p.points_m = p.points_m[~arc.explains(p.points_m, cell_m)]
    return found


def as_tables(arcs: list[Arc]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The circles and the arcs as they travel."""
    circles = [(a.x_m, a.y_m, a.radius_m, a.sigma_m) for a in arcs if a.is_circle]
    others = [(a.x_m, a.y_m, a.radius_m, a.start_rad, a.span_rad, a.sigma_m) for a in arcs if not a.is_circle]
    return (
        np.array(circles, np.float32).reshape(-1, len(CIRCLE_COLUMNS)),
        np.array(others, np.float32).reshape(-1, len(ARC_COLUMNS)),
    )
