"""What is worth keeping over a restart: where others lay on our map, and whom the operator took out.

It is believed no more than a peer is: every transform is verified on today's maps, which costs a few milliseconds, before an
edge lives again.  Without it a restarted robot has to search for everybody anew.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from protocol.geometry import SE2
from protocol.names import is_robot_id

_MAX_PEERS = 256


@dataclass(frozen=True, slots=True)
class FleetMemory:
    """Of one map frame of ours: void once that map is begun anew."""

    epoch: int = 0  # of our own map
    T_ours_theirs: Mapping[str, SE2] = field(default_factory=dict)  # by peer, of edges that lived
    unmerged: tuple[str, ...] = ()

    def encode(self) -> bytes:
        places = {peer: [T.x_m, T.y_m, T.theta_rad] for peer, T in sorted(self.T_ours_theirs.items())}
        return json.dumps({"epoch": self.epoch, "places": places, "unmerged": list(self.unmerged)}).encode()


def decode_memory(data: bytes) -> FleetMemory | None:
    """What `encode` wrote; None for anything else: a file never keeps a robot from starting."""
    try:
        kept = json.loads(data)
        places = {str(peer): SE2(*(float(v) for v in pose)) for peer, pose in list(kept["places"].items())[:_MAX_PEERS]}
        unmerged = tuple(str(peer) for peer in kept["unmerged"][:_MAX_PEERS])
        epoch = int(kept["epoch"])
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return None
    is_sound = all(is_robot_id(peer) for peer in (*places, *unmerged)) and all(
        math.isfinite(v) for T in places.values() for v in (T.x_m, T.y_m, T.theta_rad)
    )
    return FleetMemory(epoch, places, unmerged) if is_sound else None
