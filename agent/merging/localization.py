"""Where a small local map lies in a big one: the kidnapped robot, the given map, and loop closure inside one's own map."""

from __future__ import annotations

from dataclasses import replace

from agent.features.snapshot import MapSnapshot
from agent.merging.matching import match_maps
from agent.merging.result import MatchOptions, MergeResult

LOCAL_MARGIN_M = 6.0  # a local map lies in the big one almost whole, so less wall already decides


def localize(local: MapSnapshot, given: MapSnapshot, options: MatchOptions | None = None) -> MergeResult:
    """The transform of the local map's frame into the given map's: `T_ours_theirs` with the given map as ours."""
    options = options or MatchOptions()
    return match_maps(given, local, replace(options, min_margin_m=min(options.min_margin_m, LOCAL_MARGIN_M)))
