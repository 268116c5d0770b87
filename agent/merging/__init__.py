"""Two maps to one verdict, and many maps to one grid.  `merge_arrays` is the way in for other people's programs."""

from __future__ import annotations

from agent.merging.arrays import fuse_arrays, merge_arrays
from agent.merging.result import MatchOptions, MatchStatus, MergeResult

__all__ = ["MatchOptions", "MatchStatus", "MergeResult", "fuse_arrays", "merge_arrays"]
