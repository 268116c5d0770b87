"""Fourteen ways to lie to a fleet: each is an honest robot until it begins, and then this."""

from __future__ import annotations

from tests.fleet.lying_maps import AllFree, AllOccupied, Attack, DriftingMap, ErasedWalls, InventedWalls, MirroredMap, ShiftedMap
from tests.fleet.lying_words import Equivocation, FalseRecipes, ForgedTiles, Garbage, InventedRobot, ProposalSpam, Reincarnation

ATTACKS: dict[str, type[Attack]] = {
    "shifted map": ShiftedMap,
    "mirrored map": MirroredMap,
    "all free": AllFree,
    "all occupied": AllOccupied,
    "drifting map": DriftingMap,
    "invented walls": InventedWalls,
    "erased walls": ErasedWalls,
    "equivocation": Equivocation,
    "proposal spam": ProposalSpam,
    "forged tiles": ForgedTiles,
    "garbage": Garbage,
    "false recipes": FalseRecipes,
    "reincarnation": Reincarnation,
    "invented robot": InventedRobot,
}
