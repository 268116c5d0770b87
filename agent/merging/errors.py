"""What can go wrong when maps are put together.  "No match" is not among them: that is a `MergeResult`.

MergingError
  MapArrayError   an array that is no occupancy map
  FusionError     these maps cannot be drawn as one: a transform that is no transform, or a result beyond the size limit
"""

from __future__ import annotations


class MergingError(Exception):
    """Root of everything this room raises."""


class FusionError(MergingError):
    """The maps cannot be drawn into one grid."""


class MapArrayError(MergingError):
    """An array from outside is not an occupancy map."""
