"""From pairwise edges to one frame a group, in spite of wrong edges.

Every edge says how one map lies on another.  Around any loop the transforms must cancel; where they do not, some edge is
wrong.  Edges that agree with two-hop detours are trusted first and span a tree that lays out the group; graduated
non-convexity (truncated least squares, Yang et al. 2020) then moves from "all edges count" to "only edges that fit count"
while Gauss-Newton on SE(2) minimises what is left.  Edges that do not fit are named, never averaged in.
"""

from __future__ import annotations

import functools
import math
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from protocol.geometry import SE2, wrap_angle
from protocol.messages import Symmetric3

_SIGMA_M, _SIGMA_RAD = 0.05, math.radians(0.5)  # floor: maps bend by about this between robots
_GATE = 16.0  # squared residual, in sigmas, above which an edge is wrong: 3 degrees of freedom, 0.1 %
_LOOP_M, _LOOP_RAD = 0.6, math.radians(4.0)  # a two-hop detour that ends within this agrees
_STEPS = 40
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


@dataclass(frozen=True, slots=True)
class Group:
    """Robots in one frame: the map frame of `root`."""

    root: str
    T_root: Mapping[str, SE2]  # T_root_map of every member, the root at identity
    covariance: Mapping[str, Symmetric3]
    edges: tuple[Edge, ...]

    def rerooted(self, root: str) -> Group:
        """The same layout seen from another member's frame."""
        if root == self.root:
            return self
        T_new_old = self.T_root[root].inverse()
        frames = {robot: T_new_old @ T for robot, T in self.T_root.items()}
        frames[root] = SE2.identity()
        return Group(root, frames, {**self.covariance, root: (0.0,) * 6, self.root: self.covariance[root]}, self.edges)


@dataclass(frozen=True, slots=True)
class Layout:
    """All groups of two and more, and the edges that contradict them."""

    groups: tuple[Group, ...] = ()
    rejected: tuple[Edge, ...] = ()
    group_of: Mapping[str, Group] = field(default_factory=dict)


def solve(edges: Iterable[Edge]) -> Layout:
    """Lay out every connected group; the same edges give the same layout, in whatever order they come."""
    return _solve(tuple(sorted(edges, key=lambda edge: (edge.a, edge.b, edge.id))))


@functools.lru_cache(maxsize=16)
def _solve(edges: tuple[Edge, ...]) -> Layout:
    groups: list[Group] = []
    rejected: list[Edge] = []
    pending = _components(edges)
    while pending:
        component = pending.pop()
        kept, frames, covariance = _fit(component)
        if len(kept) < len(component):
            rejected += [edge for edge in component if edge not in kept]
            pending += _components(tuple(kept))
            continue
        groups.append(Group(min(frames), frames, covariance, tuple(component)))
    groups.sort(key=lambda group: group.root)
    return Layout(tuple(groups), tuple(rejected), {robot: group for group in groups for robot in group.T_root})


def _components(edges: tuple[Edge, ...]) -> list[list[Edge]]:
    """Edges by connected component."""
    leader: dict[str, str] = {}

    def find(robot: str) -> str:
        while leader.setdefault(robot, robot) != robot:
            leader[robot] = leader[leader[robot]]
            robot = leader[robot]
        return robot

    for edge in edges:
        leader[find(edge.a)] = find(edge.b)
    by_leader: dict[str, list[Edge]] = defaultdict(list)
    for edge in edges:
        by_leader[find(edge.a)].append(edge)
    return list(by_leader.values())


def _fit(edges: list[Edge]) -> tuple[list[Edge], dict[str, SE2], dict[str, Symmetric3]]:
    """Lay out one component: the edges that fit, the frames, their covariance."""
    names = sorted({edge.a for edge in edges} | {edge.b for edge in edges})
    frames = _tree_layout(names, edges, _consensus(edges))
    if len(edges) == len(names) - 1:  # no loop: nothing to weigh
        return edges, frames, _covariances(names, edges, frames)
    problem = _Problem(names, edges, frames)
    weights = problem.graduate()
    kept = [edge for edge, weight in zip(edges, weights, strict=True) if weight > 0.5]
    if len(kept) < len(edges):
        return kept, {}, {}
    fitted = problem.frames()
    return edges, fitted, _covariances(names, edges, fitted)


def _consensus(edges: list[Edge]) -> dict[bytes, tuple[int, int]]:
    """For every edge: (two-hop detours that contradict it, negated; that agree with it)."""
    hops: dict[str, dict[str, SE2]] = defaultdict(dict)
    for edge in edges:
        hops[edge.a][edge.b], hops[edge.b][edge.a] = edge.T_a_b, edge.T_a_b.inverse()
    votes = {}
    for edge in edges:
        agree = against = 0
        for middle in hops[edge.a].keys() & hops[edge.b].keys():
            detour = hops[edge.a][middle] @ hops[middle][edge.b]
            is_same = detour.distance_m(edge.T_a_b) < _LOOP_M and _turn_rad(detour, edge.T_a_b) < _LOOP_RAD
            agree, against = agree + is_same, against + (not is_same)
        votes[edge.id] = (-against if against > agree else 0, agree)
    return votes


def _tree_layout(names: list[str], edges: list[Edge], votes: Mapping[bytes, tuple[int, int]]) -> dict[str, SE2]:
    """Frames along the most trusted spanning tree, from the smallest name at identity."""
    ranked = sorted(edges, key=lambda edge: (votes[edge.id], edge.trust, edge.id), reverse=True)
    joined = {name: name for name in names}

    def find(name: str) -> str:
        while joined[name] != name:
            name = joined[name]
        return name

    tree: dict[str, list[tuple[str, SE2]]] = defaultdict(list)
    for edge in ranked:
        a, b = find(edge.a), find(edge.b)
        if a != b:
            joined[max(a, b)] = min(a, b)
            tree[edge.a].append((edge.b, edge.T_a_b))
            tree[edge.b].append((edge.a, edge.T_a_b.inverse()))
    frames, queue = {names[0]: SE2.identity()}, [names[0]]
    for here in queue:
        for there, T_here_there in tree[here]:
            if there not in frames:
                frames[there] = frames[here] @ T_here_there
                queue.append(there)
    return frames


def _turn_rad(a: SE2, b: SE2) -> float:
    return abs(wrap_angle(a.theta_rad - b.theta_rad))


class _Problem:
    """Weighted least squares over the frames of one component; the first frame stays at identity."""

    def __init__(self, names: list[str], edges: list[Edge], frames: Mapping[str, SE2]) -> None:
        index = {name: i for i, name in enumerate(names)}
        self.names = names
        self.ia = np.array([index[edge.a] for edge in edges])
        self.ib = np.array([index[edge.b] for edge in edges])
        self.measured = np.array([[edge.T_a_b.x_m, edge.T_a_b.y_m, edge.T_a_b.theta_rad] for edge in edges])  # (E, 3)
        self.information = np.array([_information(edge.covariance) for edge in edges])  # (E, 3, 3)
        self.x = np.array([[frames[name].x_m, frames[name].y_m, frames[name].theta_rad] for name in names])  # (N, 3)

    def graduate(self) -> NDArray[np.float64]:
        """Graduated non-convexity: the weight of every edge, 1 fits, 0 is wrong."""
        weights = np.ones(len(self.ia))
        squared = self._squared_residuals()
        worst = float(squared.max(initial=0.0))
        mu = _GATE / max(2.0 * worst - _GATE, 1e-9) if worst > _GATE else math.inf
        if math.isinf(mu):
            self._minimise(weights)
            squared = self._squared_residuals()
            if float(squared.max(initial=0.0)) <= _GATE:
                return weights
            mu = _GATE / (2.0 * float(squared.max()) - _GATE)
        for _ in range(_STEPS):
            low, high = mu / (mu + 1.0) * _GATE, (mu + 1.0) / mu * _GATE
            with np.errstate(divide="ignore", invalid="ignore"):
                between = np.sqrt(_GATE * mu * (mu + 1.0) / squared) - mu
            weights = np.where(squared <= low, 1.0, np.where(squared >= high, 0.0, between))
            self._minimise(weights)
            squared = self._squared_residuals()
            if np.all((weights < 1e-3) | (weights > 1.0 - 1e-3)):
                break
            mu *= 1.6
        return np.where(squared <= _GATE, 1.0, 0.0)

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
        diagonal = np.full_like(target, 1e-6)
        np.add.at(diagonal, self.ia, np.einsum("eji,ejk,eki->ei", ja, info, ja))
        np.add.at(diagonal, self.ib, np.einsum("eji,ejk,eki->ei", jb, info, jb))

        def times(v: NDArray[np.float64]) -> NDArray[np.float64]:
            moved = np.einsum("eij,ej->ei", ja, v[self.ia]) + np.einsum("eij,ej->ei", jb, v[self.ib])
            pushed = np.einsum("eij,ej->ei", info, moved)
            out = 1e-6 * v
            np.add.at(out, self.ia, np.einsum("eji,ej->ei", ja, pushed))
            np.add.at(out, self.ib, np.einsum("eji,ej->ei", jb, pushed))
            out[0] = 0.0
            return out

        x = np.zeros_like(target)
        residual = target.copy()
        residual[0] = 0.0
        z = residual / diagonal
        p, rz = z.copy(), float(np.vdot(residual, z))
        for _ in range(400):
            if rz < 1e-14:
                break
            hp = times(p)
            alpha = rz / float(np.vdot(p, hp))
            x += alpha * p
            residual -= alpha * hp
            z = residual / diagonal
            rz, previous = float(np.vdot(residual, z)), rz
            p = z + (rz / previous) * p
        return x


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


def _covariances(names: list[str], edges: list[Edge], frames: Mapping[str, SE2]) -> dict[str, Symmetric3]:
    """Marginal covariance of every frame, the first at zero; in large groups only the diagonal is worth its price."""
    n = len(names)
    if n > _DENSE_NODES:
        return {name: (0.0,) * 6 if i == 0 else (1.0, 0.0, 0.0, 1.0, 0.0, 1.0) for i, name in enumerate(names)}
    problem = _Problem(names, edges, frames)
    _, ja, jb = problem._residuals()
    hessian = _dense_hessian(n, problem.ia, problem.ib, ja, jb, problem.information)
    blocks = np.linalg.inv(hessian[3:, 3:]).reshape(n - 1, 3, n - 1, 3)
    result: dict[str, Symmetric3] = {names[0]: (0.0,) * 6}
    for i, name in enumerate(names[1:]):
        c = blocks[i, :, i, :]
        result[name] = (float(c[0, 0]), float(c[0, 1]), float(c[0, 2]), float(c[1, 1]), float(c[1, 2]), float(c[2, 2]))
    return result
