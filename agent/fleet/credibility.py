"""Whether a composer's recipe is followed: it must say what our own edges say, and use no cells that we hold back.

Holding back is a judgement about noisy maps, and each robot makes it on what it happened to see first.  Alone against many that
follow the recipe it yields, so that one group ends with one map.
"""

from __future__ import annotations

import math

from agent.fleet.frame_graph import Group
from agent.fleet.ledger import Ledger
from agent.fleet.state import Presence
from protocol.geometry import wrap_angle
from protocol.messages import GlobalMeta

_FOLLOW_M, _FOLLOW_RAD = 0.4, 0.06  # how far a composer's layout may be from ours and still be followed
_OUTVOTED_BY = 1 / 3  # of all who neither wrote the recipe nor are refused in it: more than any few liars are


def objection(ledger: Ledger, meta: GlobalMeta, group: Group) -> str:
    """Why a recipe is not followed, in words for the log; empty when it is."""
    names = {member.robot for member in meta.members}
    if ledger.robot not in names or meta.root not in names:
        return "without us or its root"
    if not names <= group.T_root.keys():
        return f"with {min(names - group.T_root.keys())}, to whom no edge of ours leads"
    T_root = group.rerooted(meta.root).T_root
    refused: set[str] = set()
    for member in meta.members:
        T, ours = member.T_global_map, T_root[member.robot]
        if member.map.frame != ledger.frame_of(member.robot):
            return f"{member.robot} draws in another frame"
        if T.distance_m(ours) > _FOLLOW_M or abs(wrap_angle(T.theta_rad - ours.theta_rad)) > _FOLLOW_RAD:
            return f"{member.robot} lies {T.distance_m(ours):.2f} m from where our edges put it"
        peer = ledger.peers.get(member.robot)
        if peer is not None and member.map.digest in peer.refused:
            refused.add(member.robot)
    if refused and not _is_outvoted(ledger, meta, group, refused):
        return f"with cells of {', '.join(sorted(refused))} that are held back here"
    return ""


def leaves_out(ledger: Ledger, meta: GlobalMeta, group: Group) -> bool:
    """Whether this recipe lacks a robot that is gone, and whose map we hold: its author may have come too late to hear of it."""
    gone = [peer for peer in ledger.peers.values() if peer.presence is Presence.LOST and peer.robot in group.T_root]
    return any(peer.admitted is not None and meta.member(peer.robot) is None for peer in gone)


def _is_outvoted(ledger: Ledger, meta: GlobalMeta, group: Group, refused: set[str]) -> bool:
    """Whether enough others hold this very map."""
    others = [ledger.peers[robot] for robot in group.T_root.keys() - refused - {ledger.robot, meta.robot}]
    voters = [peer for peer in others if peer.presence is not Presence.LOST and peer.beat is not None]
    votes = sum(peer.beat is not None and peer.beat.global_digest == meta.id() for peer in voters)
    return votes >= max(1, math.ceil(_OUTVOTED_BY * len(voters)))
