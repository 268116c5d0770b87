"""Least squares over poses that are joined by measured motions, in spite of wrong ones.

Gauss-Newton on SE(2).  When some edge does not fit, sums of distances are minimised first, which many wrong edges cannot bend
much; then only edges within a gate count, and the gate closes in four steps.  Graduated non-convexity, which starts from plain
squares, loses ten times as many good edges when a tenth of all is wrong.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

GATE = 16.0  # squared residual, in sigmas, above which an edge is wrong: 3 degrees of freedom, 0.1 %
WRONG_WEIGHT = 1e-4  # keeps poses that only wrong edges reach from floating away
STEPS = 30
DAMPING = 1e-6  # frames whose every edge has weight 0 stay where they are
DENSE_NODES = 120  # larger graphs are solved by conjugate gradients


class PoseGraph:
    """Weighted least squares over (N, 3) poses x, y, theta; the first stays where it is.

    Edge e says that pose ib[e], seen from pose ia[e], is measured[e], with information[e].
    """

    def __init__(
        self,
        ia: NDArray[np.int64],
        ib: NDArray[np.int64],
        measured: NDArray[np.float64],
        information: NDArray[np.float64],
        poses: NDArray[np.float64],
    ) -> None:
        self.ia, self.ib = ia, ib
        self.measured = measured  # (E, 3)
        self.information = information  # (E, 3, 3)
        self.x = poses  # (N, 3)

    def fit(self, is_sure: NDArray[np.bool_] | None = None) -> NDArray[np.bool_]:
        """Least squares over the edges that fit, and those that are sure (E,); (E,) which edges fit."""
        sure = np.zeros(len(self.ia), bool) if is_sure is None else is_sure
        self._minimise(np.ones(len(self.ia)))
        if self._fits(GATE).all():
            return self._fits(GATE)
        self._minimise_absolute(sure)
        return self.settle(sure)

    def settle(self, sure: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Let go of the edges that do not fit, from poses that are about right; (E,) which fit."""
        for gate in GATE * np.array([64.0, 16.0, 4.0, 1.0, 1.0, 1.0]):
            self._minimise(np.where(sure | self._fits(float(gate)), 1.0, WRONG_WEIGHT))
        return self._fits(GATE)

    def _fits(self, gate: float) -> NDArray[np.bool_]:
        return np.asarray(self.squared_residuals() <= gate)

    def _minimise_absolute(self, sure: NDArray[np.bool_]) -> None:
        """Sum of distances instead of squares: a wrong edge pulls no harder for being far off."""
        for _ in range(STEPS):
            weights = np.where(sure, 1.0, 1.0 / np.maximum(np.sqrt(self.squared_residuals()), 1.0))
            residuals, jac_a, jac_b = self.residuals()
            step = self._step(residuals, jac_a, jac_b, self.information * weights[:, None, None])
            self.x += step
            if float(np.abs(step).max()) < 1e-4:
                return

    def residuals(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """(E, 3) residuals in frame a and their (E, 3, 3) Jacobians by the poses a and b."""
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

    def squared_residuals(self) -> NDArray[np.float64]:
        """(E,) in sigmas."""
        residuals, _, _ = self.residuals()
        return np.asarray(np.einsum("ei,eij,ej->e", residuals, self.information, residuals))

    def _minimise(self, weights: NDArray[np.float64]) -> None:
        for _ in range(8):
            residuals, jac_a, jac_b = self.residuals()
            info = self.information * weights[:, None, None]
            step = self._step(residuals, jac_a, jac_b, info)
            self.x += step
            if float(np.abs(step).max()) < 1e-7:
                return

    def _step(
        self, r: NDArray[np.float64], ja: NDArray[np.float64], jb: NDArray[np.float64], info: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        n = len(self.x)
        gradient = np.zeros((n, 3))
        np.add.at(gradient, self.ia, np.einsum("eji,ejk,ek->ei", ja, info, r))
        np.add.at(gradient, self.ib, np.einsum("eji,ejk,ek->ei", jb, info, r))
        if n <= DENSE_NODES:
            hessian = dense_hessian(n, self.ia, self.ib, ja, jb, info)
            hessian[np.arange(3 * n), np.arange(3 * n)] += DAMPING
            step = np.zeros((n, 3))
            step[1:] = -np.linalg.solve(hessian[3:, 3:], gradient[1:].ravel()).reshape(-1, 3)
            return step
        return self._conjugate_gradients(-gradient, ja, jb, info)

    def _conjugate_gradients(
        self, target: NDArray[np.float64], ja: NDArray[np.float64], jb: NDArray[np.float64], info: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """(N, 3) step of a large group: the Hessian has few blocks, and only its product with a vector is needed."""
        rows, cols, values = hessian_entries(self.ia, self.ib, ja, jb, info)
        is_diagonal = rows == cols
        diagonal = DAMPING + np.bincount(rows[is_diagonal], values[is_diagonal], target.size)
        x, residual = np.zeros(target.size), target.ravel().copy()
        residual[:3] = 0.0
        z = residual / diagonal
        p, rz = z.copy(), float(residual @ z)
        enough = max(1e-14, 1e-10 * rz)
        for _ in range(400):
            if rz < enough:
                break
            hp = DAMPING * p + np.bincount(rows, values * p[cols], target.size)
            hp[:3] = 0.0
            alpha = rz / float(p @ hp)
            x += alpha * p
            residual -= alpha * hp
            z = residual / diagonal
            rz, previous = float(residual @ z), rz
            p = z + (rz / previous) * p
        return x.reshape(-1, 3)


def hessian_entries(
    ia: NDArray[np.int64],
    ib: NDArray[np.int64],
    ja: NDArray[np.float64],
    jb: NDArray[np.float64],
    info: NDArray[np.float64],
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Row, column and value of what every edge adds to the Hessian: four blocks of 3 x 3."""
    rows, cols, blocks = [], [], []
    for left, right, i, j in ((ja, ja, ia, ia), (ja, jb, ia, ib), (jb, ja, ib, ia), (jb, jb, ib, ib)):
        blocks.append(left.swapaxes(1, 2) @ info @ right)
        rows.append(np.broadcast_to((3 * i)[:, None, None] + np.arange(3)[:, None], blocks[-1].shape))
        cols.append(np.broadcast_to((3 * j)[:, None, None] + np.arange(3), blocks[-1].shape))
    return np.ravel(rows), np.ravel(cols), np.ravel(blocks)


def dense_hessian(
    n: int,
    ia: NDArray[np.int64],
    ib: NDArray[np.int64],
    ja: NDArray[np.float64],
    jb: NDArray[np.float64],
    info: NDArray[np.float64],
) -> NDArray[np.float64]:
    """(3 n, 3 n)."""
    rows, cols, values = hessian_entries(ia, ib, ja, jb, info)
    return np.asarray(np.bincount(rows * (3 * n) + cols, values, 9 * n * n), np.float64).reshape(3 * n, 3 * n)
