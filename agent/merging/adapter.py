"""Matching two plain arrays: one function, no types of ours."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from agent.merging.arrays import merge_arrays
from agent.merging.result import MatchOptions


def merge(
    map_a: NDArray[np.int8], map_b: NDArray[np.int8], resolution: float, method: str = "hybrid"
) -> tuple[bool, tuple[float, float, float] | None, float]:
    """(accepted, (x, y, theta) of b's frame in a's, score); int8 maps as in nav_msgs, row 0 the lowest y."""
    result = merge_arrays(map_a, map_b, resolution, options=MatchOptions(method=method))
    T = result.T_ours_theirs
    return result.accepted, None if T is None else (T.x_m, T.y_m, T.theta_rad), result.score - result.runner_up_score


def merge_like_the_paper(
    map_a: NDArray[np.int8], map_b: NDArray[np.int8], resolution: float
) -> tuple[bool, tuple[float, float, float] | None, float]:
    """The same by the paper's Algorithm 1, to the letter."""
    return merge(map_a, map_b, resolution, method="paper")


def merge_guarded(
    map_a: NDArray[np.int8], map_b: NDArray[np.int8], resolution: float
) -> tuple[bool, tuple[float, float, float] | None, float]:
    """The same by the paper's candidates with guards."""
    return merge(map_a, map_b, resolution, method="paper-guarded")
