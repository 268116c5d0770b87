"""Where a small local map lies in a big one: the kidnapped robot, the given map, and loop closure inside one's own map.

A local map has few walls and nearly all of them lie in the given map.  So every place of the given map is tried, and less wall
decides; in return a place that looks like another of its kind is doubted sooner.
"""

from __future__ import annotations

from dataclasses import replace

from agent.features.snapshot import MapSnapshot
from agent.merging.matching import judged, match_maps
from agent.merging.result import MatchOptions, MergeResult, Reason
from agent.merging.search import Effort, search

EVERYWHERE = Effort(scored=600, drawn=120, kept=40, targets=12, everywhere=True)

# Measured after 1 to 25 m of travel on the recordings: no wrong place at margins down to 3 m of wall.
LOCAL_MARGIN_M = 3.5
LOCAL_AGREEING_M = 6.0
LOCAL_RIVAL_SHARE = 0.8
LOCAL_OBSERVABILITY_M = 1.5
LOCAL_OBSERVABLE_SHARE = 0.05
LOCAL_UNSUSPICIOUS = 0.2
LOCAL_DISTINCTIVE_M = 0.0  # a local map lies in the given one nearly whole: there is no other end to take it for


def localize(local: MapSnapshot, given: MapSnapshot, options: MatchOptions | None = None) -> MergeResult:
    """The transform of the local map's frame into the given map's: `T_ours_theirs` with the given map as ours."""
    options = options or MatchOptions()
    if options.method != "hybrid":
        return match_maps(given, local, options)
    if not len(local.thin_walls) or not len(given.thin_walls):
        return MergeResult.none(Reason.EMPTY)
    poses, tried = search(given, local, EVERYWHERE)
    return judged(given, local, poses, tried, for_local_maps(options))


def for_local_maps(options: MatchOptions) -> MatchOptions:
    """The same bars or lower ones, except the one against look-alikes."""
    return replace(
        options,
        min_margin_m=min(options.min_margin_m, LOCAL_MARGIN_M),
        min_agreeing_m=min(options.min_agreeing_m, LOCAL_AGREEING_M),
        max_rival_share=max(options.max_rival_share, LOCAL_RIVAL_SHARE),
        near_rival_share=max(options.near_rival_share, LOCAL_RIVAL_SHARE),  # every other place of the given map is looked at
        some_rival_share=max(options.some_rival_share, LOCAL_RIVAL_SHARE),
        min_observability_m=min(options.min_observability_m, LOCAL_OBSERVABILITY_M),
        min_observable_share=min(options.min_observable_share, LOCAL_OBSERVABLE_SHARE),
        unsuspicious=min(options.unsuspicious, LOCAL_UNSUSPICIOUS),
        distinctive_m=min(options.distinctive_m, LOCAL_DISTINCTIVE_M),
    )
