"""What `mapquilt merge` does with loaded maps: match every pair, lay out those that fit, and say it.

While matching, every map lives in the frame of its own lower-left corner, as nav_msgs has it; the origins of the YAML files come
in at the very end, when the transform between the files' own map frames is told and the merged map is written in the first one's.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from agent.features.snapshot import MapSnapshot
from agent.fleet.frame_graph import Edge, solve
from agent.merging.arrays import at_corner, without_canvas
from agent.merging.fusion import FusedMap
from agent.merging.matching import match_maps
from agent.merging.result import MatchOptions, MatchStatus, MergeResult
from protocol.geometry import SE2
from protocol.grid import OccupancyGrid

Pair = tuple[int, int]


@dataclass(frozen=True, eq=False)
class LoadedMap:
    """A map file's grid, and the same cells in the frame of their lower-left corner."""

    name: str
    grid: OccupancyGrid

    @cached_property
    def snapshot(self) -> MapSnapshot:
        return MapSnapshot.of(without_canvas(at_corner(self.grid)))


@dataclass(eq=False)
class Merged:
    """All pairs tried, and the corner frame of every map that joined the first one."""

    maps: list[LoadedMap]
    options: MatchOptions
    results: Mapping[Pair, MergeResult]
    T_first: Mapping[int, SE2]  # T_first_map, corner frames; the first at identity
    inconsistent: frozenset[Pair] = frozenset()  # accepted alone, but in contradiction with the others
    fused: FusedMap | None = field(default=None)  # once written

    @property
    def is_complete(self) -> bool:
        return len(self.T_first) == len(self.maps)

    def as_json(self) -> dict[str, Any]:
        """The first pair at the top; every map and every pair below when there are more than two."""
        answer = {"method": self.options.method, **self._pair_json((0, 1))}
        answer["accepted"] = self.is_complete
        if 1 in self.T_first:
            answer.update(xyt(self.T_first[1]), map_frame=xyt(self._between_files(0, 1, self.T_first[1])))
        if len(self.maps) > 2:
            answer["maps"] = [self._map_json(i) for i in range(len(self.maps))]
            answer["pairs"] = [self._pair_json(pair) for pair in self.results]
            answer["status"] = str(MatchStatus.MERGED if self.is_complete else MatchStatus.NO)
            answer["reason"] = self.outcome()
        if self.fused is not None:
            answer["conflicting_cells"] = self.fused.conflicting_cells
            answer["agreeing_cells"] = self.fused.agreeing_cells
            answer["consistency"] = round(self.fused.consistency, 5)
        return answer

    def _map_json(self, i: int) -> dict[str, Any]:
        T = self.T_first.get(i)
        placed = {} if T is None else {**xyt(T), "map_frame": xyt(self._between_files(0, i, T))}
        return {"map": self.maps[i].name, "joined": T is not None, **placed}

    def _pair_json(self, pair: Pair) -> dict[str, Any]:
        result = self.results[pair]
        T = result.T_ours_theirs
        known = T is not None
        return {
            "a": self.maps[pair[0]].name,
            "b": self.maps[pair[1]].name,
            "accepted": result.accepted and pair not in self.inconsistent,
            "status": str(result.status),
            "reason": "inconsistent with the other maps" if pair in self.inconsistent else result.reason,
            **xyt(T),
            "covariance": np.round(result.covariance, 10).tolist() if known else None,
            "score": _rounded(result.score),
            "runner_up_score": _rounded(result.runner_up_score),
            "match_factor": _rounded(result.factor.value),
            "agree_cells": result.factor.agree,
            "disagree_cells": result.factor.disagree,
            "overlap_m2": _rounded(result.overlap_m2),
            "candidates_tried": result.candidates_tried,
            "evidence": {name: _rounded(value) for name, value in result.evidence.items()},
            "alternatives": [{**xyt(other.T_ours_theirs), "score": _rounded(other.score)} for other in result.alternatives],
            "map_frame": xyt(self._between_files(*pair, T)) if T is not None else None,
        }

    def _between_files(self, i: int, j: int, T_corners: SE2) -> SE2:
        """From corner frames to the map frames of the YAML files."""
        return self.maps[i].grid.origin @ T_corners @ self.maps[j].grid.origin.inverse()

    def as_text(self) -> str:
        lines = [f"{self.verdict(pair)} ({', '.join(figures_of(result))})" for pair, result in self.results.items()]
        return "\n".join([self.outcome(), *lines] if len(self.maps) > 2 else lines)

    def outcome(self) -> str:
        """One sentence about three maps and more."""
        alone = [Path(loaded.name).name for i, loaded in enumerate(self.maps) if i not in self.T_first]
        if len(self.T_first) == 1:
            return f"nothing lies on {Path(self.maps[0].name).name}"
        return f"{len(self.T_first)} of {len(self.maps)} maps are one" + (f"; not {', '.join(alone)}" if alone else "")

    def verdict(self, pair: Pair) -> str:
        """One sentence about a pair."""
        result = self.results[pair]
        a, b = (Path(self.maps[i].name).name for i in pair)
        T = result.T_ours_theirs
        if pair in self.inconsistent:
            return f"not merged: {b} fits {a}, but contradicts the other maps"
        if result.accepted and T is not None:
            x_m, y_m, yaw_deg = (round(value, 3) + 0.0 for value in (T.x_m, T.y_m, math.degrees(T.theta_rad)))  # no -0
            where = f"x {x_m:.3f} m, y {y_m:.3f} m, {yaw_deg:.2f} deg"
            return f"merged: {b} lies on {a} at {where}"
        kind = "ambiguous" if result.status is MatchStatus.AMBIGUOUS else "not merged"
        return f"{kind}: {b} on {a}: {result.reason}"


def merge_files(maps: list[LoadedMap], options: MatchOptions) -> Merged:
    """Match every pair; with three maps and more, only edges around which every loop closes count."""
    pairs = itertools.combinations(range(len(maps)), 2)
    results = {(i, j): match_maps(maps[i].snapshot, maps[j].snapshot, options) for i, j in pairs}
    edges = [_edge(pair, result) for pair, result in results.items() if result.accepted]
    if len(maps) == 2:
        found = results[0, 1].T_ours_theirs
        joined = {1: found} if edges and found is not None else {}
        return Merged(maps, options, results, {0: SE2.identity(), **joined})
    layout = solve(edges)
    group = layout.group_of.get(_name(0))
    frames = group.rerooted(_name(0)).T_root if group else {}
    T_first = {int(name): T for name, T in frames.items()}
    inconsistent = frozenset((int(edge.a), int(edge.b)) for edge in layout.rejected)
    return Merged(maps, options, results, {0: SE2.identity(), **T_first}, inconsistent)


def _name(i: int) -> str:
    return f"{i:04d}"


def _edge(pair: Pair, result: MergeResult) -> Edge:
    assert result.T_ours_theirs is not None
    c = result.covariance
    covariance = (c[0, 0], c[0, 1], c[0, 2], c[1, 1], c[1, 2], c[2, 2])
    i, j = pair
    return Edge(_name(i), _name(j), result.T_ours_theirs, covariance, result.score, f"{i},{j}".encode())


def figures_of(result: MergeResult) -> list[str]:
    factor = result.factor
    return [
        f"match factor {factor.value:.3f}",
        f"overlap {result.overlap_m2:.0f} m2",
        f"score {result.score:.1f}, runner-up {result.runner_up_score:.1f}",
    ]


def xyt(T: SE2 | None) -> dict[str, float | None]:
    if T is None:
        return {"x": None, "y": None, "theta": None}
    return {"x": round(T.x_m, 6), "y": round(T.y_m, 6), "theta": round(T.theta_rad, 8)}


def _rounded(value: float) -> float | None:
    return round(float(value), 6) if math.isfinite(value) else None
