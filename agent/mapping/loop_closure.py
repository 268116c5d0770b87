"""Loops that the particles missed: the path comes back to where it was, and the map does not.

Every few keyframes the last stretch of the path is laid beside the old stretch that it should meet:

    they agree             the loop is closed already; that is remembered as an edge
    they do not, or miss   the merging engine is asked how one lies in the other (the paper's use of it for loops)
    it knows, twice        both answers become edges of a pose graph (protocol/pose_graph.py), which bends the path

The bent path is taken when its edges fit and what was seen agrees better along it than before; then everything is drawn
again.  The engine comes in from outside as a plain function of two grids.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent.mapping.particle_filter import composed, inverted
from agent.mapping.path_graph import LoopEdge, apart, bent_path, pose_of, relative
from agent.mapping.redrawing import Drawing
from agent.mapping.scan_matching import Poses
from agent.mapping.submaps import agreement, around, grid_of, points_of, recent, way_m
from protocol.geometry import SE2
from protocol.grid import OccupancyGrid

FitMaps = Callable[[OccupancyGrid, OccupancyGrid], SE2 | None]  # (local, given) -> T_given_local, where it is certain

PAUSE = 12  # keyframes between two looks ...
SHORT_PAUSE = 4  # ... when there was nothing to compare with, something does not fit, or an answer is to be confirmed
SHORTEST_LOOP_M = 20.0  # of path between two stretches that are compared
REACH_M, REACH_A_METRE = 3.0, 0.03  # how far off the path may be, and by how much more for each metre since it was known
LARGEST_REACH_M = 15.0
AGREES = 0.85  # share of points: two visits of one room with the furniture moved
CONFLICTS = 0.4  # something is wrong with the map
BETTER = 0.05  # by how much the agreement has to grow
NEGLIGIBLE_M, NEGLIGIBLE_RAD = 0.1, math.radians(1.0)  # corrections that the particles make themselves
SAME_M, SAME_RAD = 0.4, math.radians(3.0)  # two answers that say the same
MOST_EDGES = 600


@dataclass(frozen=True, slots=True)
class LoopClosed:
    """What became of the robot's pose when a loop was closed."""

    moved_m: float
    turned_rad: float


class LoopCloser:
    """What is known about the loops of one map."""

    def __init__(self, fit: FitMaps | None) -> None:
        self.fit = fit
        self.edges: list[LoopEdge] = []
        self.pending: LoopEdge | None = None  # found once
        self.next_look = 0  # keyframe
        self.known = 0  # keyframe at which the path was last known to meet the old one
        self.misses = 0
        self.steps_from: Poses = np.empty((0, 3))  # the path as it was measured, before any loop bent it
        self.breaks: list[int] = []  # keyframes before which the robot was lost and found

    def every_edge(self) -> list[LoopEdge]:
        """What is known, and at the end what waits to be confirmed."""
        return [*self.edges, *([] if self.pending is None else [self.pending])]

    def look(self, drawing: Drawing, line: Poses) -> Poses | None:
        """After a keyframe: the bent path, (K, 3), when a loop is found."""
        if self.fit is None or len(line) <= self.next_look or drawing.is_bending:
            return None
        self.next_look = len(line) + SHORT_PAUSE
        way = way_m(line)
        local = recent(way)
        old = self._candidate(line, way, local, np.array(list(drawing.scans)))
        if old is None:
            return None
        given = around(old, way, drawing.oldest, local.start)
        middle = local[len(local) // 2]
        agrees = agreement(points_of(drawing, given, line), points_of(drawing, local, line))
        if agrees >= AGREES:
            self.next_look = len(line) + PAUSE
            self._remember(LoopEdge(old, middle, relative(line, old, middle)))
            return None
        T_given_local = self.fit(grid_of(drawing, local, line), grid_of(drawing, given, line))
        if T_given_local is None:
            self.misses += 1
            self.next_look = len(line) + (SHORT_PAUSE if agrees < CONFLICTS else PAUSE)
            return None
        return self._found(
            LoopEdge(old, middle, pose_of(line[old]).inverse() @ T_given_local @ pose_of(line[middle])), drawing, line
        )

    def _candidate(self, line: Poses, way: NDArray[np.float64], local: range, kept: NDArray[np.int64]) -> int | None:
        """The nearest old keyframe, of those kept, that the robot may be back at; after a miss the next one."""
        here = local[len(local) // 2]
        old = kept[way[kept] < way[local.start] - SHORTEST_LOOP_M]
        since_m = np.minimum(way[here] - way[old], way[here] - way[min(self.known, here)])
        reach_m = np.minimum(REACH_M + REACH_A_METRE * since_m, LARGEST_REACH_M)
        away_m = np.hypot(*(line[old, :2] - line[here, :2]).T)
        near = np.flatnonzero(away_m <= reach_m)
        places: list[int] = []
        for k in old[near[np.argsort(away_m[near], kind="stable")]].tolist():
            if len(places) > self.misses % 4:
                break
            if all(abs(way[k] - way[p]) > SHORTEST_LOOP_M / 2 for p in places):
                places.append(k)
        return places[self.misses % len(places)] if places else None

    def _remember(self, edge: LoopEdge) -> None:
        self.known, self.misses, self.pending = edge.b, 0, None
        self.edges.append(edge)
        if len(self.edges) > MOST_EDGES:
            del self.edges[1 : MOST_EDGES // 2 : 2]

    def _found(self, edge: LoopEdge, drawing: Drawing, line: Poses) -> Poses | None:
        """One answer of the engine: nothing new, something to be confirmed, or the confirmation."""
        off_m, off_rad = apart(edge.T_a_b, relative(line, edge.a, edge.b))
        if off_m < NEGLIGIBLE_M and off_rad < NEGLIGIBLE_RAD:
            self.next_look = len(line) + PAUSE
            self._remember(edge)
            return None
        first, self.pending = self.pending, edge
        if first is None or not says_the_same(first, edge, line):
            return None
        bent = bent_path(line, self._measured(line), self.breaks, [*self.edges, first, edge])
        if bent is None or not is_better(drawing, line, bent, first, edge):
            self.pending = None
            self.next_look = len(line) + PAUSE
            return None
        self._remember(first)
        self._remember(edge)
        self.steps_from = self._measured(line)
        return bent

    def _measured(self, line: Poses) -> Poses:
        """The path as it was measured: what came since the last bend goes on from there."""
        n = len(self.steps_from)
        if n == 0:
            return line.copy()
        shift = composed(self.steps_from[-1:], inverted(line[n - 1 : n]))
        return np.vstack([self.steps_from, composed(np.repeat(shift, len(line) - n, axis=0), line[n:])])


def is_better(drawing: Drawing, line: Poses, bent: Poses, *loops: LoopEdge) -> bool:
    """Whether what was seen at both ends of the loops agrees along the bent path, and better than before."""
    way = way_m(line)
    local = recent(way)
    given = around(loops[-1].a, way, drawing.oldest, local.start)
    after = agreement(points_of(drawing, given, bent), points_of(drawing, local, bent))
    before = agreement(points_of(drawing, given, line), points_of(drawing, local, line))
    return after > (BETTER + before if math.isfinite(before) else 0.6)


def says_the_same(first: LoopEdge, second: LoopEdge, line: Poses) -> bool:
    """Whether two answers put the newer keyframe at the same place, the steps between them believed."""
    place = pose_of(line[first.a]) @ first.T_a_b @ relative(line, first.b, second.b)
    off_m, off_rad = apart(place, pose_of(line[second.a]) @ second.T_a_b)
    return off_m < SAME_M and off_rad < SAME_RAD
