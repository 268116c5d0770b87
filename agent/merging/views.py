"""What matching derives from one map and keeps with its snapshot."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from agent.features.snapshot import MapSnapshot
from agent.merging.correlation import Places
from agent.merging.refinement import Side
from agent.merging.scoring import SEARCH_WORTH, Probe, worth_table
from agent.merging.validation import DECISION_WORTH, Witness


def probe(snapshot: MapSnapshot, count: int) -> Probe:
    return snapshot.kept(("probe", count), lambda s: Probe.sample(s.thin_walls, s.thin_kinds, count))


def side(snapshot: MapSnapshot, count: int) -> Side:
    return snapshot.kept(("side", count), lambda s: Side.of(s.thin_walls, s.walls, s.field, count))


def places(snapshot: MapSnapshot) -> Places:
    return snapshot.kept("places", lambda s: Places.of(s.working, s.thin_walls, s.thin_kinds))


def witness(snapshot: MapSnapshot) -> Witness:
    return snapshot.kept("witness", _witness)


def search_worth(snapshot: MapSnapshot) -> NDArray[np.float32]:
    """What wall points of another map are worth on this one, while searching."""
    return snapshot.kept("search worth", lambda s: worth_table(SEARCH_WORTH, s.field))


def _witness(s: MapSnapshot) -> Witness:
    points = Probe.of(s.thin_walls, s.thin_kinds)
    return Witness(s.walls, s.thin_walls, s.thin_kinds, points, s.field, worth_table(DECISION_WORTH, s.field))
