"""Least squares over the frames of one connected group, in spite of wrong edges: `PoseGraph`, with robots for poses."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protocol.geometry import SE2, wrap_angle
from protocol.messages import Symmetric3
from protocol.pose_graph import DENSE_NODES, GATE, PoseGraph, dense_hessian

_SIGMA_M, _SIGMA_RAD = 0.05, math.radians(0.5)  # floor: maps bend by about this between robots

_ROUGH = 16.0  # four times as far off as an edge that fits


@dataclass(frozen=True, slots=True)
class Edge:
    """How map b lies on map a, and how much speaks for it."""

    a: str
    b: str
    T_a_b: SE2
    covariance: Symmetric3
    trust: float
    id: bytes


class Problem(PoseGraph):
    """The frames of one component; the first stays at identity."""

    def __init__(self, names: list[str], edges: Sequence[Edge], frames: Mapping[str, SE2]) -> None:
        index = {name: i for i, name in enumerate(names)}
        self.names = names
        super().__init__(
            np.array([index[edge.a] for edge in edges]),
            np.array([index[edge.b] for edge in edges]),
            np.array([[edge.T_a_b.x_m, edge.T_a_b.y_m, edge.T_a_b.theta_rad] for edge in edges]),
            _information([edge.covariance for edge in edges]),
            np.array([[frames[name].x_m, frames[name].y_m, frames[name].theta_rad] for name in names]),
        )

    def roughly_fitting(self) -> int:
        """How many edges the frames bear out as they are, before anything is averaged."""
        return int(np.count_nonzero(self.squared_residuals() <= _ROUGH * GATE))

    def frames(self) -> dict[str, SE2]:
        return {name: SE2(float(x), float(y), wrap_angle(float(t))) for name, (x, y, t) in zip(self.names, self.x, strict=True)}


def _information(covariances: Sequence[Symmetric3]) -> NDArray[np.float64]:
    """(E, 3, 3) inverses of the edges' covariances, with the floor of what maps bend added."""
    full = np.array(covariances)[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    return np.linalg.inv(full + np.diag([_SIGMA_M**2, _SIGMA_M**2, _SIGMA_RAD**2]))


def covariances(names: list[str], edges: Sequence[Edge], frames: Mapping[str, SE2]) -> dict[str, Symmetric3]:
    """Marginal covariance of every frame, the first at zero; in large groups only the diagonal is worth its price."""
    n = len(names)
    if n > DENSE_NODES:
        return {name: (0.0,) * 6 if i == 0 else (1.0, 0.0, 0.0, 1.0, 0.0, 1.0) for i, name in enumerate(names)}
    problem = Problem(names, edges, frames)
    _, ja, jb = problem.residuals()
    hessian = dense_hessian(n, problem.ia, problem.ib, ja, jb, problem.information)
    blocks = np.linalg.inv(hessian[3:, 3:]).reshape(n - 1, 3, n - 1, 3)
    result: dict[str, Symmetric3] = {names[0]: (0.0,) * 6}
    for i, name in enumerate(names[1:]):
        c = blocks[i, :, i, :]
        result[name] = (float(c[0, 0]), float(c[0, 1]), float(c[0, 2]), float(c[1, 1]), float(c[1, 2]), float(c[2, 2]))
    return result
