"""Laws of the frame graph: true edges give true frames, wrong ones among loops are named, and order does not matter."""

from __future__ import annotations

import math
import random
from dataclasses import replace

import pytest

from agent.fleet.frame_graph import Edge, Layout, connected, solve
from protocol.geometry import SE2

COVARIANCE = (1e-3, 0.0, 0.0, 1e-3, 0.0, 1e-5)


def places(n: int, rng: random.Random) -> dict[str, SE2]:
    """T_world_map of every robot."""
    return {f"r{i:03d}": SE2(rng.uniform(-30, 30), rng.uniform(-30, 30), rng.uniform(-3, 3)) for i in range(n)}


def edge(truth: dict[str, SE2], a: str, b: str, error: SE2 | None = None) -> Edge:
    T_a_b = truth[a].inverse() @ truth[b] @ (error or SE2.identity())
    return Edge(a, b, T_a_b, COVARIANCE, 10.0, f"{a}{b}".encode())


def random_edges(truth: dict[str, SE2], degree: int, rng: random.Random, noise_m: float = 0.0) -> list[Edge]:
    """A connected graph of about this degree."""
    names = sorted(truth)
    pairs = {(names[rng.randrange(i)], names[i]) for i in range(1, len(names))}
    while len(pairs) < len(names) * degree // 2:
        a, b = sorted(rng.sample(names, 2))
        pairs.add((a, b))
    return [
        edge(truth, a, b, SE2(rng.gauss(0, noise_m), rng.gauss(0, noise_m), rng.gauss(0, 0.1 * noise_m)))
        for a, b in sorted(pairs)
    ]


def spoiled(edges: list[Edge], share: float, rng: random.Random) -> tuple[list[Edge], set[bytes]]:
    """Some edges made plainly wrong, and which."""
    wrong = {e.id for e in edges if rng.random() < share}
    off = {e.id: SE2(rng.uniform(2, 10), rng.uniform(-10, 10), rng.uniform(-3, 3)) for e in edges}
    return [replace(e, T_a_b=e.T_a_b @ off[e.id]) if e.id in wrong else e for e in edges], wrong


def worst_error_m(layout: Layout, truth: dict[str, SE2]) -> float:
    (group,) = layout.groups
    T_root_world = truth[group.root].inverse()
    return max(T.distance_m(T_root_world @ truth[robot]) for robot, T in group.T_root.items())


@pytest.mark.parametrize("n", [2, 3, 8, 40, 150])
def test_true_edges_give_true_frames(n: int) -> None:
    rng = random.Random(n)
    truth = places(n, rng)
    layout = solve(random_edges(truth, 4, rng) if n > 4 else [edge(truth, "r000", f"r{i:03d}") for i in range(1, n)])
    assert not layout.rejected
    assert set(layout.groups[0].T_root) == set(truth)
    assert worst_error_m(layout, truth) < 1e-4


def test_noise_is_averaged_over_loops() -> None:
    rng = random.Random(1)
    truth = places(30, rng)
    layout = solve(random_edges(truth, 6, rng, noise_m=0.02))
    assert not layout.rejected
    assert worst_error_m(layout, truth) < 0.2


@pytest.mark.parametrize("error", [SE2(3.0, 0.0, 0.0), SE2(0.0, 0.0, 0.5), SE2(0.0, 0.0, math.pi), SE2(8.0, -5.0, 2.0)])
def test_a_wrong_edge_among_loops_is_the_one_that_is_dropped(error: SE2) -> None:
    truth = places(4, random.Random(2))
    names = sorted(truth)
    for wrong in range(6):
        pairs = [(a, b) for a in names for b in names if a < b]
        edges = [edge(truth, *pair, error if i == wrong else None) for i, pair in enumerate(pairs)]
        layout = solve(edges)
        assert [e.id for e in layout.rejected] == [edges[wrong].id]
        assert worst_error_m(layout, truth) < 1e-4


def test_a_bridge_stays() -> None:
    """Nothing contradicts the only edge between two parts: it cannot be judged, and is believed."""
    truth = places(6, random.Random(3))
    sides = [("r000", "r001"), ("r000", "r002"), ("r001", "r002"), ("r003", "r004"), ("r003", "r005"), ("r004", "r005")]
    layout = solve([edge(truth, *pair) for pair in sides] + [edge(truth, "r002", "r003", SE2(5.0, 0.0, 1.0))])
    assert not layout.rejected
    assert len(layout.groups) == 1


def test_what_no_edge_connects_are_two_groups() -> None:
    truth = places(4, random.Random(4))
    layout = solve([edge(truth, "r000", "r001"), edge(truth, "r002", "r003")])
    assert [group.root for group in layout.groups] == ["r000", "r002"]
    assert layout.group_of["r003"] is layout.groups[1]


def test_the_edges_connected_to_a_robot_give_its_group_as_all_edges_do() -> None:
    rng = random.Random(6)
    truth = places(40, rng)
    names = sorted(truth)
    edges = [e for e in random_edges(truth, 3, rng, noise_m=0.02) if e.a[:3] == e.b[:3]]  # four groups, r00x to r03x
    whole = solve(edges)
    assert len(whole.groups) > 1
    for robot in names:
        assert solve(connected(edges, robot)).group_of.get(robot) == whole.group_of.get(robot)


def test_the_order_of_the_edges_does_not_matter() -> None:
    rng = random.Random(5)
    truth = places(12, rng)
    edges, _ = spoiled(random_edges(truth, 5, rng, noise_m=0.02), 0.1, rng)
    first = solve(edges)
    for _ in range(4):
        rng.shuffle(edges)
        other = solve(edges)
        assert [dict(g.T_root) for g in other.groups] == [dict(g.T_root) for g in first.groups]
        assert other.rejected == first.rejected


@pytest.mark.parametrize(("n", "degree"), [(12, 5), (30, 6), (100, 6)])
def test_one_wrong_edge_in_ten_costs_hardly_a_good_one(n: int, degree: int) -> None:
    good = dropped = wrong = kept = 0
    for seed in range(240 // n):
        rng = random.Random(seed)
        truth = places(n, rng)
        edges, spoilt = spoiled(random_edges(truth, degree, rng, noise_m=0.02), 0.1, rng)
        rejected = {e.id for e in solve(edges).rejected}
        good, dropped = good + len(edges) - len(spoilt), dropped + len(rejected - spoilt)
        wrong, kept = wrong + len(spoilt), kept + len(spoilt - rejected)
    assert dropped <= 0.012 * good
    assert kept <= 0.08 * wrong  # bridges, which nothing contradicts


def test_another_root_sees_the_same_layout() -> None:
    rng = random.Random(6)
    truth = places(8, rng)
    (group,) = solve(random_edges(truth, 4, rng)).groups
    moved = group.rerooted("r005")
    assert moved.T_root["r005"] == SE2.identity()
    T = moved.T_root["r002"].inverse() @ moved.T_root["r007"]
    assert T.distance_m(group.T_root["r002"].inverse() @ group.T_root["r007"]) < 1e-9
