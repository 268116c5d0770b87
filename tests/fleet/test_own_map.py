"""What a robot publishes about its own map."""

from __future__ import annotations

import numpy as np

from agent.fleet.own_map import OwnMap
from protocol.codec import decode
from protocol.features import FeatureMap
from protocol.grid import FREE, OCCUPIED, OccupancyGrid
from protocol.messages import FineTiles


def test_a_map_that_swings_between_two_states_is_always_handed_out_under_its_newest_revision() -> None:
    """As with a door that opens and shuts: an answer made for the state before last has the right cells and an old name."""
    own, held = OwnMap("r0", 1, is_frozen=False), b""
    for revision in range(1, 7):
        door = FREE if revision % 2 else OCCUPIED
        own.publish(OccupancyGrid(np.full((8, 8), door, np.int8), 0.05), FeatureMap(), frame=5)
        answer = decode(own.fine(held, b"") or b"")
        assert isinstance(answer, FineTiles)
        assert answer.map.revision == revision
        held = answer.map.digest


def test_a_version_of_a_minute_ago_is_still_handed_out() -> None:
    """On a busy machine the composer's recipe names maps as they were many states ago."""
    own, digests = OwnMap("r0", 1, is_frozen=False), []
    for width in range(1, 42):
        own.publish(OccupancyGrid(np.full((8, width), FREE, np.int8), 0.05), FeatureMap(), frame=5)
        digests.append(own.version.digest if own.version is not None else b"")
    assert own.fine(b"", digests[0]) is not None
