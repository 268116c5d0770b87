"""Poses joined by measured motions: right where the edges are right, and hardly worse when some are wrong."""

from __future__ import annotations

import numpy as np
import pytest

from protocol.geometry import SE2
from protocol.pose_graph import DENSE_NODES, PoseGraph


def ring(nodes: int, wrong: int, seed: int) -> tuple[PoseGraph, np.ndarray, int]:
    """A robot's round trip: every step measured with noise, and some pairs that meet again, a few of them wrongly."""
    rng = np.random.default_rng(seed)
    angles = np.linspace(0.0, 2 * np.pi, nodes, endpoint=False)
    true = np.stack([20 * np.cos(angles), 20 * np.sin(angles), angles + np.pi / 2], axis=1)
    pairs = [(i, i + 1) for i in range(nodes - 1)] + [(i, nodes - 1 - i) for i in range(10)]
    measured = []
    for number, (i, j) in enumerate(pairs):
        step = SE2(*true[i]).inverse() @ SE2(*true[j])
        noise = rng.normal(0.0, (0.01, 0.01, 0.002))
        noise += np.array([3.0, -2.0, 0.4]) * (number >= len(pairs) - wrong)
        measured.append([step.x_m + noise[0], step.y_m + noise[1], step.theta_rad + noise[2]])
    start = [true[0]]
    for step in measured[: nodes - 1]:
        pose = SE2(*start[-1]) @ SE2(*step)
        start.append(np.array([pose.x_m, pose.y_m, pose.theta_rad]))
    ends = np.array(pairs)
    information = np.broadcast_to(np.diag([1e4, 1e4, 2.5e5]), (len(pairs), 3, 3))
    return PoseGraph(ends[:, 0], ends[:, 1], np.array(measured), information, np.array(start)), true, len(pairs)


@pytest.mark.parametrize("nodes", [60, DENSE_NODES + 40])
@pytest.mark.parametrize("wrong", [0, 3])
def test_a_round_trip_closes_in_spite_of_wrong_edges(nodes: int, wrong: int) -> None:
    graph, true, edges = ring(nodes, wrong, seed=1)
    drift_m = float(np.hypot(*(graph.x[-1] - true[-1])[:2]))
    is_sure = np.arange(edges) < nodes - 1
    fits = graph.fit(is_sure)
    assert fits[: edges - wrong].all()
    assert not fits[edges - wrong :].any()
    assert drift_m > 0.3
    assert float(np.hypot(*(graph.x - true)[-10:, :2].T).max()) < 0.1
    assert np.array_equal(graph.x[0], true[0])
