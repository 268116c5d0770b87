"""Circles fitted to many pieces of wall at once: the best arc of every piece, or none.

A hypothesis is the circle through three nearby cells of one piece.  It counts the cells on it less those beside it; the best
two are refined by least squares on the radial distance and keep the longest run of cells without a gap, so a few cells of
clutter that happen to be concyclic are no arc.  Pieces lie one behind the other in flat arrays: a map has a hundred small ones,
and numpy asks as much for ten numbers as for a thousand.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

MIN_RADIUS_M, MAX_RADIUS_M = 0.15, 15.0
MIN_CELLS = 7
MIN_LENGTH_M = 0.7  # of wall on the circle
MIN_SPAN_RAD = math.radians(50)  # a flatter arc has no centre to speak of
GAP_M = 0.45  # along the wall, that an arc may jump
MIN_DENSITY = 0.6  # cells on the arc per cell of its length
MAX_CLUTTER = 0.3  # cells beside the arc, per cell on it
MIN_SAGITTA = 2.5  # tolerances: flatter, and a straight wall with a bump would do
MAX_RMS_CELLS = 0.45  # cells whose centres lie anywhere within the wall's cell have 0.29
MAX_SIGMA_M = 0.25
HYPOTHESES = 40  # a piece; three cells on a half-explained circle are found with p > 0.99
REACHES_M = (0.5, 1.2, 3.0)  # how far apart the three cells may lie: pillars, columns, rotundas
TRIES = 2  # of the hypotheses, refined
ROUNDS = 3  # of fitting and choosing the run anew
MAX_PIECE_CELLS = 600
INDEPENDENT_M = 0.3  # cells closer than this do not err independently

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


@dataclass(frozen=True, slots=True, eq=False)
class Fits:
    """Circles, and for each the cells of its piece: one row a circle, or a (circle, cell)."""

    piece: NDArray[np.int64]  # (C,)
    circles: NDArray[np.float64]  # (C, 3) x, y, radius
    start_rad: NDArray[np.float64]  # (C,)
    span_rad: NDArray[np.float64]  # (C,) counter-clockwise from the start
    owner: NDArray[np.int64]  # (N,) row of the circle, ascending
    points_m: NDArray[np.float64]  # (N, 2)
    on: NDArray[np.bool_]  # (N,) cells of the arc

    def only(self, kept: NDArray[np.bool_]) -> Fits:
        rows = kept[self.owner]
        owner = (np.cumsum(kept) - 1)[self.owner[rows]]
        return Fits(
            self.piece[kept],
            self.circles[kept],
            self.start_rad[kept],
            self.span_rad[kept],
            owner,
            self.points_m[rows],
            self.on[rows],
        )

    def count(self, which: NDArray[np.bool_]) -> NDArray[np.int64]:
        return np.bincount(self.owner[which], minlength=len(self.circles))

    def off_m(self) -> NDArray[np.float64]:
        """(N,) how far each cell lies from its circle."""
        off: NDArray[np.float64] = np.abs(_radial(self.points_m, self.circles[self.owner])[1])
        return off


def tolerance_m(cell_m: float) -> float:
    """A cell's centre lies this near the wall that occupied it."""
    return 0.6 * cell_m + 0.02


def best_arcs(pieces: Pieces) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The pieces that have an arc, and (K, 6) x, y, radius, start, span and sigma of each one's best."""
    fits = _refined(pieces, *_promising(pieces))
    if not len(fits.piece):
        return fits.piece, np.zeros((0, 6))
    sigma = _sigma_m(fits, pieces.cell_m)
    good = np.flatnonzero(sigma <= MAX_SIGMA_M)
    piece, first = np.unique(fits.piece[good], return_index=True)
    best = good[first]
    return piece, np.column_stack([fits.circles[best], fits.start_rad[best], fits.span_rad[best], sigma[best]])


def _promising(pieces: Pieces) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
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


def _refined(pieces: Pieces, piece: NDArray[np.int64], circles: NDArray[np.float64]) -> Fits:
    """Fit, keep the longest unbroken run, and fit again; those that are arcs after all."""
    sizes = pieces.sizes[piece]
    owner = np.repeat(np.arange(len(piece)), sizes)
    rows = np.arange(len(owner)) + (pieces.starts[piece] - (np.cumsum(sizes) - sizes))[owner]
    none = np.zeros(len(piece))
    fits = Fits(piece, circles, none, none, owner, pieces.points_m[rows], np.zeros(len(owner), np.bool_))
    fits = _longest_runs(fits, pieces.tolerance_m)
    for _ in range(ROUNDS):
        fits = fits.only((fits.count(fits.on) >= MIN_CELLS) & (fits.span_rad >= MIN_SPAN_RAD))
        fits = _fitted(fits)
        fits = fits.only((fits.circles[:, 2] >= MIN_RADIUS_M) & (fits.circles[:, 2] <= MAX_RADIUS_M))
        fits = _longest_runs(fits, pieces.tolerance_m)
    return fits.only(_are_round(fits, pieces))


def _longest_runs(fits: Fits, tolerance: float) -> Fits:
    """On each circle the largest set of cells without a gap between them; a full circle is cut at its widest gap."""
    rows = np.flatnonzero(fits.off_m() < tolerance)
    owner, circles = fits.owner[rows], len(fits.circles)
    away = fits.points_m[rows] - fits.circles[owner, :2]
    angle = np.arctan2(away[:, 1], away[:, 0])
    order = np.lexsort((angle, owner))
    rows, angle = rows[order], angle[order]
    count = np.bincount(owner, minlength=circles)
    first = np.cumsum(count) - count
    last = (first + count - 1)[count > 0]
    following = np.arange(1, len(rows) + 1)
    following[last] = first[count > 0]
    gap = angle[following] - angle
    gap[last] += math.tau
    is_break = gap > np.maximum(GAP_M / fits.circles[:, 2], math.radians(8))[owner]
    is_break[np.lexsort((gap, owner))[last]] = True
    cuts = np.bincount(owner[is_break], minlength=circles)
    earlier: NDArray[np.int64] = np.cumsum(is_break) - is_break
    base = np.cumsum(cuts) - cuts
    run = base[owner] + (earlier - earlier[first[owner]]) % cuts[owner]
    length = np.bincount(run, minlength=int(cuts.sum()))
    of_run = np.repeat(np.arange(circles), cuts)
    longest = np.lexsort((length, of_run))[(np.cumsum(cuts) - 1)[owner]]
    kept = run == longest
    begins = np.zeros(len(rows), np.bool_)
    begins[following[is_break]] = True
    start, end = np.zeros(circles), np.zeros(circles)
    start[owner[kept & begins]], end[owner[kept & is_break]] = angle[kept & begins], angle[kept & is_break]
    on = np.zeros(len(fits.owner), np.bool_)
    on[rows[kept]] = True
    span = np.remainder(end - start, math.tau)
    return Fits(fits.piece, fits.circles, start, span, fits.owner, fits.points_m, on)


def _fitted(fits: Fits) -> Fits:
    """The algebraic (Kasa) fit, then Gauss-Newton steps on the radial distance, which take its bias away."""
    owner, points, n = fits.owner[fits.on], fits.points_m[fits.on], len(fits.circles)
    count = np.maximum(np.bincount(owner, minlength=n), 1)
    middle = np.stack([np.bincount(owner, points[:, k], n) for k in (0, 1)], axis=1) / count[:, None]
    local = points - middle[owner]
    a, b, c = _solved(2 * local, (local * local).sum(axis=1), owner, n).T
    radius2 = c + a * a + b * b
    algebraic = np.column_stack([middle[:, 0] + a, middle[:, 1] + b, np.sqrt(np.maximum(radius2, 0.0))])
    circles = np.where((radius2 > 0)[:, None], algebraic, fits.circles)
    for _ in range(2):
        towards, residual = _jacobian(points, circles[owner])
        circles = circles + _solved(towards, residual, owner, n)
    return Fits(fits.piece, circles, fits.start_rad, fits.span_rad, fits.owner, fits.points_m, fits.on)


def _solved(A: NDArray[np.float64], b: NDArray[np.float64], owner: NDArray[np.int64], n: int) -> NDArray[np.float64]:
    """(n, 3) least squares with the rows (A, 1): normal equations and Cramer's rule, as three unknowns need no better."""
    xx, xy, xz, yy, yz, zz = _normal_matrix(A, owner, n)
    xx, yy, zz = xx + 1e-9, yy + 1e-9, zz + 1e-9
    p, q, r = (np.bincount(owner, w, n) for w in (A[:, 0] * b, A[:, 1] * b, b))
    c0, c1, c2 = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    c3, c4, c5 = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    det = xx * c0 + xy * c1 + xz * c2
    return np.column_stack([c0 * p + c1 * q + c2 * r, c1 * p + c3 * q + c4 * r, c2 * p + c4 * q + c5 * r]) / det[:, None]


def _normal_matrix(A: NDArray[np.float64], owner: NDArray[np.int64], n: int) -> tuple[NDArray[np.float64], ...]:
    """The six sums of the rows (A, 1) with one another."""
    x, y = A.T
    return tuple(np.asarray(np.bincount(owner, w, n), np.float64) for w in (x * x, x * y, x, y * y, y, np.ones(len(x))))


def _radial(points: NDArray[np.float64], circles: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Vectors from the centre to each point, and how far beyond its circle the point lies."""
    away = points - circles[:, :2]
    x, y = away.T
    return away, np.sqrt(x * x + y * y) - circles[:, 2]


def _jacobian(points: NDArray[np.float64], circles: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Unit vectors from the centre to each point, and how far beyond its circle the point lies."""
    away, beyond = _radial(points, circles)
    return away / np.maximum(beyond + circles[:, 2], 1e-9)[:, None], beyond


def _are_round(fits: Fits, pieces: Pieces) -> NDArray[np.bool_]:
    """(C,) whether the run is long, bowed, dense and smooth enough to be a round wall, with little clutter beside it."""
    tolerance, radius, span = pieces.tolerance_m, fits.circles[:, 2], fits.span_rad
    on, length = fits.count(fits.on), span * radius
    sagitta = radius * (1 - np.cos(np.minimum(span, math.pi) / 2))
    off = fits.off_m()
    away = fits.points_m - fits.circles[fits.owner, :2]
    ahead = np.remainder(np.arctan2(away[:, 1], away[:, 0]) - fits.start_rad[fits.owner], math.tau)
    beside = fits.count((off >= tolerance) & (off < 3 * tolerance) & (ahead <= span[fits.owner]))
    squares = np.bincount(fits.owner[fits.on], off[fits.on] ** 2, len(radius))
    is_long = (span >= MIN_SPAN_RAD) & (length >= MIN_LENGTH_M) & (sagitta >= MIN_SAGITTA * tolerance)
    is_dense = (on * pieces.wall_m[fits.piece] >= MIN_DENSITY * length) & (beside <= MAX_CLUTTER * on)
    is_smooth = squares <= on * (MAX_RMS_CELLS * pieces.cell_m) ** 2
    are_round: NDArray[np.bool_] = is_long & is_dense & is_smooth & (on > 0)
    return are_round


def _sigma_m(fits: Fits, cell_m: float) -> NDArray[np.float64]:
    """(C,) uncertainty of centre and radius together: the largest of the three."""
    owner, n = fits.owner[fits.on], len(fits.circles)
    towards, residual = _jacobian(fits.points_m[fits.on], fits.circles[owner])
    xx, xy, xz, yy, yz, zz = _normal_matrix(towards, owner, n)
    information = np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=1).reshape(-1, 3, 3)
    spread2 = np.maximum(np.bincount(owner, residual**2, n) / zz, (0.29 * cell_m) ** 2)
    widest = np.linalg.pinv(information).diagonal(axis1=1, axis2=2).max(axis=1)
    sigma: NDArray[np.float64] = np.sqrt(spread2 * max(1.0, INDEPENDENT_M / cell_m) * widest)
    return sigma
