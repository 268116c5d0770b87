"""Least squares over the frames of one connected group, in spite of wrong edges.

Gauss-Newton on SE(2).  When some edge does not fit, sums of distances are minimised first, which many wrong edges cannot bend
much; then only edges within a gate count, and the gate closes in four steps.  Graduated non-convexity, which starts from plain
squares, loses ten times as many good edges when a tenth of all is wrong.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protocol.geometry import SE2, wrap_angle
from protocol.messages import Symmetric3

_SIGMA_M, _SIGMA_RAD = 0.05, math.radians(0.5)  # floor: maps bend by about this between robots
_GATE = 16.0  # squared residual, in sigmas, above which an edge is wrong: 3 degrees of freedom, 0.1 %
_WRONG_WEIGHT = 1e-4  # keeps robots that only wrong edges reach from floating away
_STEPS = 30
_DENSE_NODES = 120  # larger groups are solved by conjugate gradients


@dataclass(frozen=True, slots=True)
class Edge:
    """How map b lies on map a, and how much speaks for it."""

    a: str
    b: str
    T_a_b: SE2
    covariance: Symmetric3
    trust: float
    id: bytes


class Problem:
    """Weighted least squares over the frames of one component; the first frame stays at identity."""

    def __init__(self, names: list[str], edges: list[Edge], frames: Mapping[str, SE2]) -> None:
        index = {name: i for i, name in enumerate(names)}
        self.names = names
        self.ia = np.array([index[edge.a] for edge in edges])
        self.ib = np.array([index[edge.b] for edge in edges])
        self.measured = np.array([[edge.T_a_b.x_m, edge.T_a_b.y_m, edge.T_a_b.theta_rad] for edge in edges])  # (E, 3)
        self.information = np.array([_information(edge.covariance) for edge in edges])  # (E, 3, 3)
        self.x = np.array([[frames[name].x_m, frames[name].y_m, frames[name].theta_rad] for name in names])  # (N, 3)

    def fit(self) -> NDArray[np.bool_]:
        """Least squares over the edges that fit; (E,) which do."""
        everything = np.ones(len(self.ia))
        self._minimise(everything)
        if self._fits(_GATE).all():
            return self._fits(_GATE)
        self._minimise_absolute()
        for gate in _GATE * np.array([64.0, 16.0, 4.0, 1.0, 1.0, 1.0]):
            self._minimise(np.where(self._fits(float(gate)), 1.0, _WRONG_WEIGHT))
        return self._fits(_GATE)

    def _fits(self, gate: float) -> NDArray[np.bool_]:
        return np.asarray(self._squared_residuals() <= gate)

    def _minimise_absolute(self) -> None:
        """Sum of distances instead of squares: a wrong edge pulls no harder for being far off."""
        for _ in range(_STEPS):
            weights = 1.0 / np.maximum(np.sqrt(self._squared_residuals()), 1.0)
            residuals, jac_a, jac_b = self._residuals()
            step = self._step(residuals, jac_a, jac_b, self.information * weights[:, None, None])
            self.x += step
            if float(np.abs(step).max()) < 1e-4:
                return

    def frames(self) -> dict[str, SE2]:
        return {name: SE2(float(x), float(y), wrap_angle(float(t))) for name, (x, y, t) in zip(self.names, self.x, strict=True)}

    def _residuals(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """(E, 3) residuals in frame a and their (E, 3, 3) Jacobians by the frames a and b."""
        a, b = self.x[self.ia], self.x[self.ib]
        c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
        dx, dy = b[:, 0] - a[:, 0], b[:, 1] - a[:, 1]
        local = np.stack([c * dx + s * dy, -s * dx + c * dy, b[:, 2] - a[:, 2]], axis=1)
        residuals = local - self.measured
        residuals[:, 2] = (residuals[:, 2] + math.pi) % math.tau - math.pi
        jac_a, jac_b = np.zeros((len(a), 3, 3)), np.zeros((len(a), 3, 3))
        jac_b[:, 0, 0], jac_b[:, 0, 1], jac_b[:, 1, 0], jac_b[:, 1, 1], jac_b[:, 2, 2] = c, s, -s, c, 1.0
        jac_a[:, :, :2] = -jac_b[:, :, :2]
        jac_a[:, 0, 2], jac_a[:, 1, 2], jac_a[:, 2, 2] = local[:, 1], -local[:, 0], -1.0
        return residuals, jac_a, jac_b

    def _squared_residuals(self) -> NDArray[np.float64]:
        residuals, _, _ = self._residuals()
        return np.asarray(np.einsum("ei,eij,ej->e", residuals, self.information, residuals))

    def _minimise(self, weights: NDArray[np.float64]) -> None:
        for _ in range(8):
            residuals, jac_a, jac_b = self._residuals()
            info = self.information * weights[:, None, None]
            step = self._step(residuals, jac_a, jac_b, info)
            self.x += step
            if float(np.abs(step).max()) < 1e-7:
                return

    def _step(
        self, r: NDArray[np.float64], ja: NDArray[np.float64], jb: NDArray[np.float64], info: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        n = len(self.names)
        gradient = np.zeros((n, 3))
        np.add.at(gradient, self.ia, np.einsum("eji,ejk,ek->ei", ja, info, r))
        np.add.at(gradient, self.ib, np.einsum("eji,ejk,ek->ei", jb, info, r))
        if n <= _DENSE_NODES:
            hessian = _dense_hessian(n, self.ia, self.ib, ja, jb, info)
            hessian[np.arange(3 * n), np.arange(3 * n)] += 1e-6  # frames whose every edge has weight 0 stay where they are
            step = np.zeros((n, 3))
            step[1:] = -np.linalg.solve(hessian[3:, 3:], gradient[1:].ravel()).reshape(-1, 3)
            return step
        return self._conjugate_gradients(-gradient, ja, jb, info)

    def _conjugate_gradients(
        self, target: NDArray[np.float64], ja: NDArray[np.float64], jb: NDArray[np.float64], info: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """(N, 3) step of a large group: the Hessian has few blocks, and only its product with a vector is needed."""
        times, diagonal = _sparse_hessian(len(self.names), self.ia, self.ib, ja, jb, info)
        x, residual = np.zeros(target.size), target.ravel().copy()
        residual[:3] = 0.0
        z = residual / diagonal
        p, rz = z.copy(), float(residual @ z)
        enough = max(1e-14, 1e-10 * rz)
        for _ in range(400):
            if rz < enough:
                break
            hp = times(p)
            hp[:3] = 0.0
            alpha = rz / float(p @ hp)
            x += alpha * p
            residual -= alpha * hp
            z = residual / diagonal
            rz, previous = float(residual @ z), rz
            p = z + (rz / previous) * p
        return x.reshape(-1, 3)


def _sparse_hessian(
    n: int,
    ia: NDArray[np.int64],
    ib: NDArray[np.int64],
    ja: NDArray[np.float64],
    jb: NDArray[np.float64],
    info: NDArray[np.float64],
) -> tuple[Callable[[NDArray[np.float64]], NDArray[np.float64]], NDArray[np.float64]]:
    """Product of the Hessian with a vector (3 N,), and its diagonal."""
    blocks, rows, cols = [], [], []
    for left, right, i, j in ((ja, ja, ia, ia), (ja, jb, ia, ib), (jb, ja, ib, ia), (jb, jb, ib, ib)):
        blocks.append(np.einsum("eji,ejk,ekl->eil", left, info, right, optimize=True))
        rows.append(np.broadcast_to((3 * i)[:, None, None] + np.arange(3)[:, None], blocks[-1].shape))
        cols.append(np.broadcast_to((3 * j)[:, None, None] + np.arange(3), blocks[-1].shape))
    row, col, value = np.ravel(rows), np.ravel(cols), np.ravel(blocks)
    is_diagonal = row == col
    diagonal = np.asarray(1e-6 + np.bincount(row[is_diagonal], value[is_diagonal], 3 * n), np.float64)

    def times(v: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(1e-6 * v + np.bincount(row, value * v[col], 3 * n))

    return times, diagonal


def _information(covariance: Symmetric3) -> NDArray[np.float64]:
    """(3, 3) inverse of an edge's covariance, with the floor of what maps bend added."""
    xx, xy, xt, yy, yt, tt = covariance
    full = np.array([[xx, xy, xt], [xy, yy, yt], [xt, yt, tt]])
    return np.linalg.inv(full + np.diag([_SIGMA_M**2, _SIGMA_M**2, _SIGMA_RAD**2]))


def _dense_hessian(
    n: int,
    ia: NDArray[np.int64],
    ib: NDArray[np.int64],
    ja: NDArray[np.float64],
    jb: NDArray[np.float64],
    info: NDArray[np.float64],
) -> NDArray[np.float64]:
    hessian = np.zeros((n, n, 3, 3))
    for left, right, i, j in ((ja, ja, ia, ia), (ja, jb, ia, ib), (jb, ja, ib, ia), (jb, jb, ib, ib)):
        np.add.at(hessian, (i, j), np.einsum("eji,ejk,ekl->eil", left, info, right))
    return hessian.swapaxes(1, 2).reshape(3 * n, 3 * n)


def covariances(names: list[str], edges: list[Edge], frames: Mapping[str, SE2]) -> dict[str, Symmetric3]:
    """Marginal covariance of every frame, the first at zero; in large groups only the diagonal is worth its price."""
    n = len(names)
    if n > _DENSE_NODES:
        return {name: (0.0,) * 6 if i == 0 else (1.0, 0.0, 0.0, 1.0, 0.0, 1.0) for i, name in enumerate(names)}
    problem = Problem(names, edges, frames)
    _, ja, jb = problem._residuals()
    hessian = _dense_hessian(n, problem.ia, problem.ib, ja, jb, problem.information)
    blocks = np.linalg.inv(hessian[3:, 3:]).reshape(n - 1, 3, n - 1, 3)
    result: dict[str, Symmetric3] = {names[0]: (0.0,) * 6}
    for i, name in enumerate(names[1:]):
        c = blocks[i, :, i, :]
        result[name] = (float(c[0, 0]), float(c[0, 1]), float(c[0, 2]), float(c[1, 1]), float(c[1, 2]), float(c[2, 2]))
    return result
