"""Who composes, and in whose frame: the same answer everywhere, from what everybody knows."""

from __future__ import annotations

from agent.fleet.frame_graph import Group
from agent.fleet.ledger import Ledger
from agent.fleet.state import Presence
from protocol.messages import NO_DIGEST, GlobalMap, GlobalMeta


def composer_of(ledger: Ledger, group: Group) -> str:
    """The smallest robot that is there; a frozen map composes only among frozen maps."""
    here = [robot for robot in group.T_root if _is_here(ledger, robot)]
    moving = [robot for robot in here if not _is_frozen(ledger, robot)]
    return min(moving or here or [ledger.robot])


def root_of(ledger: Ledger, group: Group, held: GlobalMap | None, root: str) -> str:
    """Whose frame is the global one: a given map's, else the one it was, else the smallest robot's.

    When groups meet, the frame of the larger one stays: fewer robots see their map jump.
    """
    frozen = [robot for robot in group.T_root if _is_frozen(ledger, robot)]
    if frozen:
        return root if root in frozen else min(frozen)
    known = [(len(meta.members), meta.root) for meta in recipes_of(ledger, group) if meta.root in group.T_root]
    largest, theirs = max(known, key=lambda pair: pair[0], default=(0, min(group.T_root)))
    if held is not None and root in group.T_root and largest <= len(held.members):
        return root
    return theirs


def recipes_of(ledger: Ledger, group: Group) -> list[GlobalMeta]:
    """Recipes that members of the group published, of maps that some member still holds."""
    peers = [ledger.peers[robot] for robot in sorted(group.T_root) if robot in ledger.peers]
    held = {peer.beat.global_digest for peer in peers if peer.beat is not None}
    return [peer.meta for peer in peers if peer.meta is not None and peer.meta_id in held]


def holds_unknown_map(ledger: Ledger, group: Group, robot: str) -> bool:
    """Whether a peer of our group holds a global map of which nobody told us the recipe."""
    peer = ledger.peers.get(robot)
    if robot not in group.T_root or peer is None or peer.beat is None:
        return False
    asked = peer.beat.global_digest
    return asked != NO_DIGEST and all(other.meta_id != asked for other in ledger.peers.values())


def _is_here(ledger: Ledger, robot: str) -> bool:
    return robot == ledger.robot or ledger.peers[robot].presence is not Presence.LOST


def _is_frozen(ledger: Ledger, robot: str) -> bool:
    return ledger.options.is_frozen if robot == ledger.robot else ledger.peers[robot].is_frozen
