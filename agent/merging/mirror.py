"""The test against mirror images: would the maps fit better were one of them turned over?

Buildings are full of wings and rooms laid out as mirror images, and a scanner mounted upside down maps all of a building
that way.  Such maps agree over a hundred metres of wall without any rival among the transforms, because the transform that
fits is a reflection.  So the reflection is tried as well: where it fits with less doubt, the fit at hand is the look-alike.
"""

from __future__ import annotations

import numpy as np

from agent.features.snapshot import MapSnapshot
from agent.merging.grounds import weighed
from agent.merging.search import FIRST_PASS, search
from agent.merging.verdict import Grounds
from protocol.grid import OccupancyGrid

MIN_SHARE = 0.5  # of the score at hand: a reflection with less wall than this says nothing,
DOUBTFUL = 1.0  # unless the fit at hand is this suspicious; then
MIN_SHARE_IN_DOUBT = 0.3  # says enough
MIN_LESS_SUSPICION = 0.3  # recordings and their images differ by 0.6, true pairs that reflect so well by 0.1 at most; but
AS_WELL, LESS_SUSPICION = 0.9, 0.06  # a reflection with nearly the score at hand is never less suspicious by 0.05 of a true pair


def is_mirror_image(ours: MapSnapshot, theirs: MapSnapshot, grounds: Grounds) -> bool:
    """Whether a reflection lays one map on the other with less doubt than the transform of these grounds."""
    if len(ours.thin_walls) < len(theirs.thin_walls):
        ours, theirs = theirs, ours  # the smaller map is the cheaper one to turn over
    turned = theirs.kept("mirrored", mirrored)
    poses, _ = search(ours, turned, FIRST_PASS)
    if not len(poses):
        return False
    reflection = weighed(ours, turned, poses)[0]
    share = MIN_SHARE if grounds.suspicion < DOUBTFUL else MIN_SHARE_IN_DOUBT
    less = LESS_SUSPICION if reflection.score > AS_WELL * grounds.score else MIN_LESS_SUSPICION
    return reflection.score > share * grounds.score and reflection.suspicion < grounds.suspicion - less


def mirrored(snapshot: MapSnapshot) -> MapSnapshot:
    """The map turned over: its columns from right to left."""
    return MapSnapshot.of(OccupancyGrid(np.ascontiguousarray(snapshot.grid.cells[:, ::-1]), snapshot.grid.resolution_m))
