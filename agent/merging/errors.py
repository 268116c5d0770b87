"""What can go wrong when maps are put together.  "No match" is not among them: that is a `MergeResult`.

MergingError
  FusionError     these maps cannot be drawn as one: a transform that is no transform, or a result beyond the size limit
"""

from __future__ import annotations


class MergingError(Exception):
    """Root of everything this room raises."""


class FusionError(MergingError):
    """The maps cannot be drawn into one grid."""
