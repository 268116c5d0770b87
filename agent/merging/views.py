"""What matching derives from one map and keeps with its snapshot."""

from __future__ import annotations

from agent.features.snapshot import MapSnapshot
from agent.merging.correlation import Places
from agent.merging.refinement import Side
from agent.merging.scoring import Probe
from agent.merging.validation import Witness


def probe(snapshot: MapSnapshot, count: int) -> Probe:
    return snapshot.kept(("probe", count), lambda s: Probe.sample(s.thin_walls, s.thin_kinds, count))


def side(snapshot: MapSnapshot, count: int) -> Side:
    return snapshot.kept(("side", count), lambda s: Side.of(s.thin_walls, s.walls, s.field, count))


def places(snapshot: MapSnapshot) -> Places:
    return snapshot.kept("places", lambda s: Places.of(s.working, s.thin_walls, s.thin_kinds))


def witness(snapshot: MapSnapshot) -> Witness:
    return snapshot.kept("witness", lambda s: Witness(s.thin_walls, s.thin_kinds, Probe.of(s.thin_walls, s.thin_kinds), s.field))
