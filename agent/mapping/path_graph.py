"""The path of a robot as a pose graph: steps as they were measured, and loops, which say how far keyframes really lie apart."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent.mapping.particle_filter import composed, inverted
from agent.mapping.scan_matching import Poses, difference
from protocol.geometry import SE2
from protocol.pose_graph import PoseGraph

NODES = 100  # of the graph: keyframes between two nodes move with them
STEP_SIGMA = (0.01, 0.004)  # metres and radians, of each keyframe's step ...
METRE_SIGMA = (0.03, 0.004)  # ... and of each metre
BREAK_SIGMA = (2.0, 0.5)  # where the robot was lost and found
LOOP_SIGMA = (0.05, math.radians(0.5))  # of a fit, and of how much a stretch is bent itself


@dataclass(frozen=True, slots=True)
class LoopEdge:
    """How two keyframes really lie."""

    a: int  # the older
    b: int
    T_a_b: SE2

    def renumbered(self, numbers: NDArray[np.int64]) -> LoopEdge:
        """The same edge when keyframe k is called `numbers[k]`."""
        return LoopEdge(int(numbers[self.a]), int(numbers[self.b]), self.T_a_b)


def bent_path(line: Poses, measured: Poses, breaks: list[int], loops: list[LoopEdge]) -> Poses | None:
    """The path that fits steps and loops best; None when the last two loops are not among those that fit."""
    nodes = np.unique(np.append(np.arange(0, len(line), math.ceil(len(line) / NODES)), len(line) - 1))
    chain = composed(inverted(measured[nodes[:-1]]), measured[nodes[1:]])
    joints = [snapped(edge, nodes, measured) for edge in loops]
    joints = [joint for joint in joints if joint[0] != joint[1]]
    ia = np.array([*range(len(nodes) - 1), *(a for a, _, _ in joints)])
    ib = np.array([*range(1, len(nodes)), *(b for _, b, _ in joints)])
    between = np.vstack([chain, *(step[None] for _, _, step in joints)])
    information = np.vstack(
        [step_information(measured, nodes, breaks), np.repeat(diagonal(LOOP_SIGMA)[None], len(joints), axis=0)]
    )
    graph = PoseGraph(ia, ib, between, information, line[nodes].copy())
    fits = graph.fit(is_sure=np.arange(len(ia)) < len(chain))
    return spread(line, nodes, graph.x) if fits[-2:].all() else None


def snapped(edge: LoopEdge, nodes: NDArray[np.int64], measured: Poses) -> tuple[int, int, NDArray[np.float64]]:
    """An edge between the nodes nearest to its keyframes."""
    a, b = (int(np.argmin(np.abs(nodes - k))) for k in (edge.a, edge.b))
    T = relative(measured, int(nodes[a]), edge.a) @ edge.T_a_b @ relative(measured, edge.b, int(nodes[b]))
    return a, b, np.array([T.x_m, T.y_m, T.theta_rad])


def step_information(measured: Poses, nodes: NDArray[np.int64], breaks: list[int]) -> NDArray[np.float64]:
    """(N - 1, 3, 3) of the way from node to node."""
    steps = np.hypot(*np.diff(measured[:, :2], axis=0).T)
    variances = np.square(np.array(STEP_SIGMA) + np.array(METRE_SIGMA) * steps[:, None])  # (K - 1, 2)
    for k in breaks:
        if 0 < k <= len(variances):
            variances[k - 1] += np.square(BREAK_SIGMA)
    sums = np.add.reduceat(variances, nodes[:-1], axis=0)
    return np.stack([diagonal((math.sqrt(m), math.sqrt(rad))) for m, rad in sums])


def spread(line: Poses, nodes: NDArray[np.int64], moved: Poses) -> Poses:
    """(K, 3) the keyframes between the nodes, carried along by both, the nearer the more."""
    k = np.arange(len(line))
    before = np.clip(np.searchsorted(nodes, k, side="right") - 1, 0, len(nodes) - 2)
    share = ((k - nodes[before]) / (nodes[before + 1] - nodes[before]))[:, None]
    ends = [composed(moved[n], composed(inverted(line[nodes[n]]), line)) for n in (before, before + 1)]
    return np.asarray(ends[0] + share * difference(ends[1], ends[0]))


def relative(line: Poses, a: int, b: int) -> SE2:
    return pose_of(line[a]).inverse() @ pose_of(line[b])


def apart(a: SE2, b: SE2) -> tuple[float, float]:
    """(metres, radians) between two poses."""
    T = a.inverse() @ b
    return math.hypot(T.x_m, T.y_m), abs(T.theta_rad)


def pose_of(row: NDArray[np.float64]) -> SE2:
    return SE2(float(row[0]), float(row[1]), math.remainder(float(row[2]), math.tau))


def diagonal(sigma: tuple[float, float]) -> NDArray[np.float64]:
    """(3, 3) information of independent errors in metres, metres, radians."""
    return np.diag([sigma[0] ** -2, sigma[0] ** -2, sigma[1] ** -2])
