"""Circles fitted to many pieces of wall at once: the best arc of every piece, or none.

The most promising hypotheses (`circle_hypotheses.py`) are refined by least squares on the radial distance and keep the longest
run of cells without a gap, so a few cells of clutter that happen to be concyclic are no arc.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent.features.circle_hypotheses import (
    MAX_CLUTTER,
    MAX_RADIUS_M,
    MIN_DENSITY,
    MIN_LENGTH_M,
    MIN_RADIUS_M,
    Pieces,
    promising,
)

MIN_CELLS = 7
MIN_SPAN_RAD = math.radians(50)  # a flatter arc has no centre to speak of
GAP_M = 0.45  # along the wall, that an arc may jump
MIN_SAGITTA = 2.5  # tolerances: flatter, and a straight wall with a bump would do
MAX_RMS_CELLS = 0.45  # cells whose centres lie anywhere within the wall's cell have 0.29
MAX_SIGMA_M = 0.25
ROUNDS = 3  # of fitting and choosing the run anew
INDEPENDENT_M = 0.3  # cells closer than this do not err independently


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


def best_arcs(pieces: Pieces) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The pieces that have an arc, and (K, 6) x, y, radius, start, span and sigma of each one's best."""
    fits = _refined(pieces, *promising(pieces))
    if not len(fits.piece):
        return fits.piece, np.zeros((0, 6))
    sigma = _sigma_m(fits, pieces.cell_m)
    good = np.flatnonzero(sigma <= MAX_SIGMA_M)
    piece, first = np.unique(fits.piece[good], return_index=True)
    best = good[first]
    return piece, np.column_stack([fits.circles[best], fits.start_rad[best], fits.span_rad[best], sigma[best]])


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
