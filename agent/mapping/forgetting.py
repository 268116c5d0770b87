"""Keyframes that nobody needs any more, let go: a robot that goes round in one building for days remembers no longer a path.

Needed are keyframes whose scan is kept, ends of loops, and the newest ones, which particles may still remember otherwise.  The
others are taken out of the path, and what counts keyframes counts anew; scans in between are told by the keyframe before them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from agent.mapping.kept_scans import NEVER_THINNED

if TYPE_CHECKING:
    from agent.mapping.local_map import LocalMap
    from agent.mapping.loop_closure import LoopCloser
    from agent.mapping.redrawing import Drawing

MOST_KEYFRAMES = 16_384  # of the path: 1.2 MB, three hours of driving


def forget_keyframes(local: LocalMap) -> None:
    """Shorten a path that is too long, where that makes it much shorter; not while anything is drawn along it."""
    line = local.filter.line
    if len(line) < max(MOST_KEYFRAMES, 2 * len(local.drawing.scans)) or local.drawing.fresh is not None:
        return
    stays = needed(local)
    numbers = np.cumsum(stays) - 1  # of those that stay; of another, that of the last one before it
    last = np.flatnonzero(stays)[numbers]
    local.scans.rebase(last, line, numbers)
    local.filter.line = line[stays]
    local.filter.forgotten = int(numbers[local.filter.forgotten])
    renumber_drawing(local.drawing, stays, numbers)
    renumber_loops(local.loops, stays, numbers)


def needed(local: LocalMap) -> NDArray[np.bool_]:
    """(K,)"""
    line, loops = local.filter.line, local.loops
    stays = np.zeros(len(line), bool)
    stays[min(local.filter.forgotten, len(line) - NEVER_THINNED) :] = True
    stays[[0, local.drawing.oldest, loops.known, max(len(loops.steps_from) - 1, 0)]] = True
    stays[list(local.drawing.scans)] = True
    for edge in loops.every_edge():
        stays[[edge.a, edge.b]] = True
    return stays


def renumber_drawing(drawing: Drawing, stays: NDArray[np.bool_], numbers: NDArray[np.int64]) -> None:
    drawing.poses = drawing.poses[stays[drawing.oldest :]]
    drawing.scans = {int(numbers[k]): scan for k, scan in drawing.scans.items()}
    drawing.oldest = int(numbers[drawing.oldest])


def renumber_loops(loops: LoopCloser, stays: NDArray[np.bool_], numbers: NDArray[np.int64]) -> None:
    loops.edges = [edge.renumbered(numbers) for edge in loops.edges]
    loops.pending = loops.pending and loops.pending.renumbered(numbers)
    loops.next_look -= len(stays) - int(np.count_nonzero(stays))
    loops.known = int(numbers[loops.known])
    loops.steps_from = loops.steps_from[stays[: len(loops.steps_from)]]
    loops.breaks = sorted({int(numbers[k - 1]) + 1 for k in loops.breaks if k > 0})
