"""The fleet at one moment, put together for people: status pages, logs and the live view."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from agent.fleet.composition import Composition
from agent.fleet.ledger import Ledger, pair_key
from agent.fleet.pairs import PairWork
from agent.fleet.peer import Peer
from agent.fleet.state import FleetState, FrameState, PeerState
from protocol.geometry import SE2
from protocol.messages import Evidence


class Overview:
    """Reads from all parts, changes none."""

    def __init__(self, ledger: Ledger, pairs: PairWork, composition: Composition) -> None:
        self._ledger, self._pairs, self._composition = ledger, pairs, composition

    def state(self, now_s: float, T_map_robot: SE2 | None, *, is_twin: bool) -> FleetState:
        """The fleet as we see it."""
        group, ledger = self._ledger.group, self._ledger
        global_map = self._composition.global_map
        root = self._composition.root if group is not None and self._composition.root in group.T_root else None
        seen = group.rerooted(root) if group is not None and root else group
        frames: Mapping[str, FrameState] = {}
        if seen is not None:
            frames = {
                robot: FrameState(T, seen.covariance[robot], self._silent_s(robot, now_s)) for robot, T in seen.T_root.items()
            }
        rejected = ledger.rejected()
        return FleetState(
            self._ledger.robot,
            is_twin,
            seen.root if seen is not None else self._ledger.robot,
            self._composition.composer,
            tuple(self._peer_state(peer, frames, now_s) for _, peer in sorted(ledger.peers.items())),
            frames,
            tuple(evidence for _, evidence in sorted(ledger.live.items())),
            tuple(evidence for _, evidence in sorted(ledger.live.items()) if evidence.id() in rejected),
            None if global_map is None else replace(global_map, T_global_robot=self._poses(frames, T_map_robot)),
            dict(self._ledger.counts),
        )

    def _silent_s(self, robot: str, now_s: float) -> float:
        peer = self._ledger.peers.get(robot)
        return now_s - peer.heard_s if peer else 0.0

    def _peer_state(self, peer: Peer, frames: Mapping[str, FrameState], now_s: float) -> PeerState:
        pair = self._pairs.pairs.get(peer.robot)
        beat = peer.beat
        T_map_robot, frame = beat.T_map_robot if beat else None, frames.get(peer.robot)
        live: Evidence | None = self._ledger.live.get(pair_key(self._ledger.robot, peer.robot))
        return PeerState(
            peer.robot,
            peer.presence,
            now_s - peer.heard_s,
            peer.is_frozen,
            peer.trust.is_quarantined(now_s),
            peer.robot in self._ledger.roster.unmerged,
            peer.map,
            peer.known_area_m2,
            round(peer.trust.strikes),
            frame.T_global_map @ T_map_robot if frame is not None and T_map_robot is not None else None,
            "merged" if live is not None else pair.phase if pair else "unseen",
            pair.reason if pair else "",
            pair.attempts if pair else 0,
            live.match_factor if live is not None else pair.match_factor if pair else 0.0,
        )

    def _poses(self, frames: Mapping[str, FrameState], T_own_map_robot: SE2 | None) -> dict[str, SE2]:
        poses = {}
        for robot, frame in frames.items():
            peer = self._ledger.peers.get(robot)
            T_map_robot = (
                T_own_map_robot if robot == self._ledger.robot else peer.beat.T_map_robot if peer and peer.beat else None
            )
            if T_map_robot is not None:
                poses[robot] = frame.T_global_map @ T_map_robot
        return poses
