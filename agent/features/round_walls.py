"""Circles and arcs: round pieces of wall that no straight line explains, with an algebraic fit, refined, and its covariance.

A hypothesis is the circle through three nearby cells of one connected piece.  It counts the length of wall that it explains
without a gap, so a few cells of clutter that happen to be concyclic explain nothing.  The best is refined by least squares on
the radial distance; its cells are erased, and the piece is asked again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from protocol.features import ARC_COLUMNS, CIRCLE_COLUMNS

MIN_RADIUS_M, MAX_RADIUS_M = 0.15, 15.0
MIN_CELLS = 7
MIN_LENGTH_M = 0.7  # of wall on the circle
MIN_SPAN_RAD = math.radians(50)  # a flatter arc has no centre to speak of
CIRCLE_SPAN_RAD = math.radians(290)  # seen from nearly all sides: a circle, not an arc
GAP_M = 0.45  # along the wall, that an arc may jump
MIN_DENSITY = 0.6  # cells on the arc per cell of its length
MAX_CLUTTER = 0.3  # cells beside the arc, per cell on it
MIN_SAGITTA = 2.5  # tolerances: flatter, and a straight wall with a bump would do
MAX_RMS_CELLS = 0.45  # cells whose centres lie anywhere within the wall's cell have 0.29
MAX_SIGMA_M = 0.25
HYPOTHESES = 40  # a piece; three cells on a half-explained circle are found with p > 0.99
REACHES_M = (0.5, 1.2, 3.0)  # how far apart the three cells may lie: pillars, columns, rotundas
TRIES = 2  # of the hypotheses, refined
MAX_PIECES = 100  # the largest
MAX_PIECE_CELLS = 600
KEPT_PIECES = 256  # at most 2.5 MB
MAX_PER_PIECE = 4
MAX_ARCS = 64
INDEPENDENT_M = 0.3  # cells closer than this do not err independently


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
        away = points_m - (self.x_m, self.y_m)
        angle = np.remainder(np.arctan2(away[:, 1], away[:, 0]) - self.start_rad, math.tau)
        off = np.abs(np.hypot(away[:, 0], away[:, 1]) - self.radius_m)
        near: NDArray[np.bool_] = (off < 3 * _tolerance_m(resolution_m)) & (self.is_circle | (angle <= self.span_rad))
        return near


def find_arcs(points_m: NDArray[np.float64], piece: NDArray[np.int64], resolution_m: float) -> list[Arc]:
    """Arcs among (N, 2) points, `piece[i]` numbering the connected piece that point i belongs to; the longest first."""
    sizes = np.bincount(piece) if len(piece) else np.zeros(0, np.int64)
    order = np.argsort(piece, kind="stable")
    starts = np.concatenate([[0], np.cumsum(sizes)])
    largest = [i for i in np.argsort(-sizes, kind="stable")[:MAX_PIECES].tolist() if sizes[i] >= MIN_CELLS]
    arcs: list[Arc] = []
    for i in largest:
        rows = order[starts[i] : starts[i + 1]]
        stride = -(-len(rows) // MAX_PIECE_CELLS)
        arcs += _arcs_of_piece(points_m[rows[::stride]].tobytes(), resolution_m, stride)
    return sorted(arcs, key=lambda arc: -arc.radius_m * arc.span_rad)[:MAX_ARCS]


def as_tables(arcs: list[Arc]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The circles and the arcs as they travel."""
    circles = [(a.x_m, a.y_m, a.radius_m, a.sigma_m) for a in arcs if a.is_circle]
    others = [(a.x_m, a.y_m, a.radius_m, a.start_rad, a.span_rad, a.sigma_m) for a in arcs if not a.is_circle]
    return (
        np.array(circles, np.float32).reshape(-1, len(CIRCLE_COLUMNS)),
        np.array(others, np.float32).reshape(-1, len(ARC_COLUMNS)),
    )


@lru_cache(maxsize=KEPT_PIECES)
def _arcs_of_piece(xy: bytes, cell_m: float, stride: int) -> tuple[Arc, ...]:
    """The arcs of one piece, of whose cells every `stride`-th is given, as bytes of (N, 2) float64.

    From one second to the next most pieces of a growing map stay as they are: theirs are remembered.
    """
    points = np.frombuffer(xy).reshape(-1, 2)
    found: list[Arc] = []
    while len(found) < MAX_PER_PIECE and len(points) >= MIN_CELLS:
        arc = _best_arc(points, cell_m, stride)
        if arc is None:
            break
        found.append(arc)
        points = points[~arc.explains(points, cell_m)]
    return tuple(found)


def _best_arc(points: NDArray[np.float64], cell_m: float, stride: int) -> Arc | None:
    circles = _through_three(points, np.random.default_rng(len(points)))
    if not len(circles):
        return None
    tolerance_m = _tolerance_m(cell_m)
    off = np.abs(np.hypot(*(points[None] - circles[:, None, :2]).transpose(2, 0, 1)) - circles[:, 2:])
    hits = (off < tolerance_m).sum(axis=1) - MAX_CLUTTER * ((off >= tolerance_m) & (off < 3 * tolerance_m)).sum(axis=1)
    best_first = np.argsort(-hits, kind="stable")[:TRIES]
    for i in best_first[hits[best_first] * stride * cell_m >= MIN_LENGTH_M * MIN_DENSITY]:
        arc = _refined(points, circles[i], cell_m, stride)
        if arc is not None:
            return arc
    return None


def _through_three(points: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """(K, 3) circles x, y, r through random triples of nearby points."""
    n = len(points)
    first = rng.integers(n, size=HYPOTHESES)
    away = np.hypot(*(points[None] - points[first][:, None]).transpose(2, 0, 1))
    reach = np.asarray(REACHES_M)[np.arange(HYPOTHESES) % len(REACHES_M)]
    keys = np.where(away <= reach[:, None], rng.random((HYPOTHESES, n)), 2.0)
    keys[np.arange(HYPOTHESES), first] = 3.0
    others = np.argpartition(keys, 1, axis=1)[:, :2] if n > 2 else np.zeros((HYPOTHESES, 2), np.int64)
    near = np.take_along_axis(keys, others, axis=1).max(axis=1) < 2.0
    p, q, r = points[first[near]], points[others[near, 0]], points[others[near, 1]]
    return _circumcircles(p, q - p, r - p)


def _circumcircles(p: NDArray[np.float64], u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
    cross = 2 * (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])
    uu, vv = (u * u).sum(axis=1), (v * v).sum(axis=1)
    bent = np.abs(cross) > 1e-6
    safe = np.where(bent, cross, 1.0)
    centre = np.stack([(v[:, 1] * uu - u[:, 1] * vv) / safe, (u[:, 0] * vv - v[:, 0] * uu) / safe], axis=1)
    radius = np.hypot(centre[:, 0], centre[:, 1])
    fits = bent & (radius >= MIN_RADIUS_M) & (radius <= MAX_RADIUS_M)
    circles: NDArray[np.float64] = np.column_stack([p + centre, radius])[fits]
    return circles


def _refined(points: NDArray[np.float64], circle: NDArray[np.float64], cell_m: float, stride: int) -> Arc | None:
    """Fit, keep the longest unbroken run, and fit again; None when it is no arc after all."""
    tolerance_m = _tolerance_m(cell_m)
    on, _, span = _longest_run(points, np.flatnonzero(_off_circle(points, circle) < tolerance_m), circle)
    for _ in range(2):
        if len(on) < MIN_CELLS or span < MIN_SPAN_RAD:
            return None
        circle = _fitted(points[on], circle)
        if not MIN_RADIUS_M <= circle[2] <= MAX_RADIUS_M:
            return None
        on = np.flatnonzero(_off_circle(points, circle) < tolerance_m)
        on, start, span = _longest_run(points, on, circle)
    if not _is_round(points, on, circle, start, span, cell_m, stride):
        return None
    sigma = _sigma_m(points[on], circle, cell_m)
    if sigma > MAX_SIGMA_M:
        return None
    return Arc(float(circle[0]), float(circle[1]), float(circle[2]), math.remainder(start, math.tau), span, sigma)


def _is_round(
    points: NDArray[np.float64],
    on: NDArray[np.int64],
    circle: NDArray[np.float64],
    start_rad: float,
    span_rad: float,
    cell_m: float,
    stride: int,
) -> bool:
    """Whether the run is long, bowed, dense and smooth enough to be a round wall, with little clutter beside it."""
    tolerance_m, radius = _tolerance_m(cell_m), float(circle[2])
    length = span_rad * radius
    sagitta = radius * (1 - math.cos(min(span_rad, math.pi) / 2))
    if span_rad < MIN_SPAN_RAD or length < MIN_LENGTH_M or sagitta < MIN_SAGITTA * tolerance_m:
        return False
    if len(on) * stride * cell_m < MIN_DENSITY * length:
        return False
    off = _off_circle(points, circle)
    angle = np.remainder(np.arctan2(*(points - circle[:2]).T[::-1]) - start_rad, math.tau)
    beside = np.count_nonzero((off >= tolerance_m) & (off < 3 * tolerance_m) & (angle <= span_rad))
    return bool(beside <= MAX_CLUTTER * len(on) and np.sqrt(np.mean(off[on] ** 2)) <= MAX_RMS_CELLS * cell_m)


def _tolerance_m(cell_m: float) -> float:
    """A cell's centre lies this near the wall that occupied it."""
    return 0.6 * cell_m + 0.02


def _off_circle(points: NDArray[np.float64], circle: NDArray[np.float64]) -> NDArray[np.float64]:
    off: NDArray[np.float64] = np.abs(np.hypot(points[:, 0] - circle[0], points[:, 1] - circle[1]) - circle[2])
    return off


def _fitted(points: NDArray[np.float64], circle: NDArray[np.float64]) -> NDArray[np.float64]:
    """The algebraic (Kasa) fit, then Gauss-Newton steps on the radial distance, which take its bias away."""
    middle = points.mean(axis=0)
    local = points - middle
    A = np.column_stack([2 * local, np.ones(len(local))])
    solution = _solved(A, (local * local).sum(axis=1))
    radius2 = solution[2] + solution[0] ** 2 + solution[1] ** 2
    if radius2 > 0:
        circle = np.array([*(solution[:2] + middle), math.sqrt(radius2)])
    for _ in range(2):
        circle = circle + _solved(*_jacobian(points, circle))
    return circle


def _solved(A: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Least squares by normal equations and Cramer's rule: three unknowns near the origin need no better."""
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = (A.T @ A + 1e-9 * np.eye(3)).tolist()
    p, q, r = (A.T @ b).tolist()
    c0, c1, c2 = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    c3, c4, c5 = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    det = xx * c0 + xy * c1 + xz * c2
    solution: NDArray[np.float64] = np.array([c0 * p + c1 * q + c2 * r, c1 * p + c3 * q + c4 * r, c2 * p + c4 * q + c5 * r]) / det
    return solution


def _jacobian(points: NDArray[np.float64], circle: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    away = points - circle[:2]
    distance = np.maximum(np.hypot(away[:, 0], away[:, 1]), 1e-9)
    return np.column_stack([away / distance[:, None], np.ones(len(points))]), distance - circle[2]


def _sigma_m(points: NDArray[np.float64], circle: NDArray[np.float64], cell_m: float) -> float:
    J, residual = _jacobian(points, circle)
    spread = max(float(np.sqrt(np.mean(residual**2))), 0.29 * cell_m)
    covariance = spread**2 * max(1.0, INDEPENDENT_M / cell_m) * np.linalg.pinv(J.T @ J)
    return float(np.sqrt(np.diag(covariance).max()))


def _longest_run(
    points: NDArray[np.float64], on: NDArray[np.int64], circle: NDArray[np.float64]
) -> tuple[NDArray[np.int64], float, float]:
    """The largest set of points on the circle without a gap between them: rows, start and span."""
    if len(on) < 2:
        return on, 0.0, 0.0
    away = points[on] - circle[:2]
    angle = np.arctan2(away[:, 1], away[:, 0])
    order = np.argsort(angle, kind="stable")
    gaps = np.diff(np.concatenate([angle[order], angle[order[:1]] + math.tau]))
    breaks = np.flatnonzero(gaps > max(GAP_M / circle[2], math.radians(8)))
    if not len(breaks):
        widest = int(gaps.argmax())
        return on, float(angle[order[(widest + 1) % len(on)]]), math.tau - float(gaps[widest])
    lengths = np.diff(np.concatenate([breaks, breaks[:1] + len(on)]))
    k = int(lengths.argmax())
    longest = order.take(np.arange(breaks[k] + 1, breaks[k] + 1 + lengths[k]), mode="wrap")
    start = float(angle[longest[0]])
    return on[np.sort(longest)], start, float(np.remainder(angle[longest[-1]] - start, math.tau))
