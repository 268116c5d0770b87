"""From pairwise edges to one frame a group, in spite of wrong edges.

Every edge says how one map lies on another.  Around any loop the transforms must cancel; where they do not, some edge is
wrong.  Edges that agree with two-hop detours are trusted first and span a tree that lays out the group; `frame_solver`
then finds the frames most edges fit.  Edges that do not fit are named, never averaged in.
"""

from __future__ import annotations

import functools
import math
import random
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from agent.fleet.frame_solver import Edge, Problem, covariances
from protocol.geometry import SE2, wrap_angle
from protocol.messages import Symmetric3

__all__ = ["Edge", "Group", "Layout", "solve"]

_SMALL_GROUP, _MAX_TREES = 16, 40
_LOOP_M, _LOOP_RAD = 0.6, math.radians(4.0)  # a two-hop detour that ends within this agrees


@dataclass(frozen=True, slots=True)
class Group:
    """Robots in one frame: the map frame of `root`."""

    root: str
    T_root: Mapping[str, SE2]  # T_root_map of every member, the root at identity
    covariance: Mapping[str, Symmetric3]
    edges: tuple[Edge, ...]

    def rerooted(self, root: str) -> Group:
        """The same layout seen from another member's frame; the others' covariances stay those seen from the old root."""
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
        kept, frames, covariance = _fit(tuple(component))
        if len(kept) < len(component):
            kept_ids = {edge.id for edge in kept}
            rejected += [edge for edge in component if edge.id not in kept_ids]
            pending += _components(tuple(kept))
            continue
        groups.append(Group(min(frames), frames, covariance, tuple(component)))
    groups.sort(key=lambda group: group.root)
    return Layout(tuple(groups), tuple(rejected), {robot: group for group in groups for robot in group.T_root})


def connected(edges: Iterable[Edge], robot: str) -> list[Edge]:
    """The edges of everybody whom a chain of edges joins to this robot: the others cannot move its frame."""
    beside: dict[str, list[Edge]] = defaultdict(list)
    for edge in edges:
        beside[edge.a].append(edge)
        beside[edge.b].append(edge)
    reached, queue, found = {robot}, [robot], {}
    for here in queue:
        for edge in beside.get(here, ()):
            found[edge.id] = edge
            there = edge.b if edge.a == here else edge.a
            if there not in reached:
                reached.add(there)
                queue.append(there)
    return list(found.values())


def _components(edges: tuple[Edge, ...]) -> list[list[Edge]]:
    """Edges by connected component."""
    joined = _Joined()
    for edge in edges:
        joined.join(edge.a, edge.b)
    by_leader: dict[str, list[Edge]] = defaultdict(list)
    for edge in edges:
        by_leader[joined.leader(edge.a)].append(edge)
    return list(by_leader.values())


class _Joined:
    """Disjoint sets of robots, each with one of them as its leader."""

    def __init__(self) -> None:
        self._above: dict[str, str] = {}

    def leader(self, robot: str) -> str:
        above = self._above
        while above.setdefault(robot, robot) != robot:
            above[robot] = above[above[robot]]
            robot = above[robot]
        return robot

    def join(self, a: str, b: str) -> bool:
        """False when they were in one set already."""
        leader_a, leader_b = self.leader(a), self.leader(b)
        self._above[leader_a] = leader_b
        return leader_a != leader_b


@functools.lru_cache(maxsize=256)  # an edge changes one group; the others stay as they are
def _fit(edges: tuple[Edge, ...]) -> tuple[Sequence[Edge], Mapping[str, SE2], Mapping[str, Symmetric3]]:
    """Lay out one component: the edges that fit, the frames, their covariance."""
    names = sorted({edge.a for edge in edges} | {edge.b for edge in edges})
    votes = _consensus(edges)
    frames = _tree_layout(names, sorted(edges, key=lambda edge: (votes[edge.id], edge.trust, edge.id), reverse=True))
    if len(edges) == len(names) - 1:  # no loop: nothing to weigh
        return edges, frames, covariances(names, edges, frames)
    problem = Problem(names, edges, frames)
    fits = problem.fit()
    if not fits.all() and len(names) <= _SMALL_GROUP:
        other = max(_layouts(names, edges, votes), key=Problem.roughly_fitting)
        others_fits = other.settle(np.zeros(len(edges), bool))
        if others_fits.sum() > fits.sum() + 1:  # one more may be a wrong one that nothing contradicts
            problem, fits = other, others_fits
    if not fits.all():
        return [edge for edge, fit in zip(edges, fits, strict=True) if fit], {}, {}
    fitted = problem.frames()
    return edges, fitted, covariances(names, edges, fitted)


def _consensus(edges: Sequence[Edge]) -> dict[bytes, tuple[int, int]]:
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


def _layouts(names: list[str], edges: Sequence[Edge], votes: Mapping[bytes, tuple[int, int]]) -> Iterator[Problem]:
    """Layouts along different spanning trees, the most trusted first: in a small group one wrong branch spoils all."""
    ranked = sorted(edges, key=lambda edge: (votes[edge.id], edge.trust, edge.id), reverse=True)
    yield Problem(names, edges, _tree_layout(names, ranked))
    rng = random.Random(len(edges))
    for _ in range(_MAX_TREES):
        drawn = {edge.id: rng.random() ** ((1.0 - votes[edge.id][0]) / (1.0 + votes[edge.id][1])) for edge in ranked}
        yield Problem(names, edges, _tree_layout(names, sorted(edges, key=lambda edge: (drawn[edge.id], edge.id), reverse=True)))


def _tree_layout(names: list[str], ranked: list[Edge]) -> dict[str, SE2]:
    """Frames along the spanning tree of the first edges, from the smallest name at identity."""
    joined = _Joined()
    tree: dict[str, list[tuple[str, SE2]]] = defaultdict(list)
    for edge in ranked:
        if joined.join(edge.a, edge.b):
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
