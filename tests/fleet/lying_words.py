"""Liars that change their words on the way out, or what they answer when they are asked."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from protocol.codec import decode, encode
from protocol.geometry import SE2
from protocol.grid import FREE, UNKNOWN, OccupancyGrid
from protocol.messages import Beat, Estate, FineTiles, GlobalMeta, MapVersion, Message, Stance, Statement
from protocol.tiles import TileDelta, TileMap
from tests.fleet.lying_maps import Attack, Liar
from tests.fleet.processes import Node, Tap
from tests.fleet.simulation import Fleet


class _WordAttack(Attack, Tap):
    """Changes words, not maps."""

    def begin(self, fleet: Fleet, node: Node) -> None:
        node.tap = self


class Equivocation(_WordAttack):
    """Tells every peer another transform under the same number."""

    def say(self, fleet: Fleet, node: Node, message: Message, to: str) -> list[bytes]:
        if isinstance(message, Statement):
            turn = SE2(0.3 * (len(to) + ord(to[-1]) % 7), 0.1, 0.02)
            message = replace(message, evidence=replace(message.evidence, T_a_b=message.evidence.T_a_b @ turn))
        return [encode(message)]

    def every_second(self, fleet: Fleet, node: Node, age_s: float) -> None:
        assert node.coordinator is not None
        for statement in list(node.coordinator._ledger.mine.values()):
            fleet.publish(node, statement)


class ProposalSpam(_WordAttack):
    """Proposes random transforms to everybody, ten a second."""

    def every_second(self, fleet: Fleet, node: Node, age_s: float) -> None:
        coordinator = node.coordinator
        assert coordinator is not None
        for statement in list(coordinator._ledger.mine.values()):
            for _ in range(10):
                coordinator._ledger.seq += 1
                T = SE2(fleet.rng.uniform(-20, 20), fleet.rng.uniform(-20, 20), fleet.rng.uniform(-math.pi, math.pi))
                evidence = replace(statement.evidence, T_a_b=T, proposer=node.robot, agree=10**6, disagree=0)
                lie = Statement(node.robot, coordinator.boot, coordinator._ledger.seq, statement.other, Stance.PROPOSE, evidence)
                fleet.publish(node, lie)


class ForgedTiles(_WordAttack):
    """Announces one map and hands out another."""

    def answer(self, fleet: Fleet, node: Node, key: str, data: bytes | None) -> bytes | None:
        if data is None or not key.startswith("map/fine"):
            return data
        message = decode(data)
        if not isinstance(message, FineTiles):
            return data
        lie = bytes(b ^ 0x55 for b in message.delta.digest)
        delta: TileDelta = replace(message.delta, digest=lie)
        return encode(replace(message, delta=delta, map=replace(message.map, digest=lie)))

    def every_second(self, fleet: Fleet, node: Node, age_s: float) -> None:
        liar = node.explorer
        assert isinstance(liar, Liar)
        flip = int(age_s) % 2

        def change(grid: OccupancyGrid) -> OccupancyGrid:
            is_striped = np.eye(grid.height, grid.width, k=flip) > 0
            return replace(grid, cells=np.where(is_striped, UNKNOWN, grid.cells).astype(np.int8))

        liar.change = change
        fleet.share_map(node)


class Garbage(_WordAttack):
    """Noise on its own keys, a hundred a second, and messages in the names of others."""

    def every_second(self, fleet: Fleet, node: Node, age_s: float) -> None:
        for other in fleet.nodes.values():
            if other is not node:
                for _ in range(100):
                    fleet.transmit(node, other, fleet.rng.randbytes(60), None)


class FalseRecipes(_WordAttack):
    """As composer: recipes that misplace the members."""

    is_detectable = False  # nobody follows, so nobody needs to prove it

    def say(self, fleet: Fleet, node: Node, message: Message, to: str) -> list[bytes]:
        if isinstance(message, GlobalMeta):
            moved = tuple(
                replace(m, T_global_map=m.T_global_map @ SE2(2.0, 1.0, 0.1)) if m.robot != message.root else m
                for m in message.members
            )
            message = replace(message, members=moved, digest=bytes(16))
        return [encode(message)]

    def every_second(self, fleet: Fleet, node: Node, age_s: float) -> None:
        assert node.coordinator is not None
        meta = node.coordinator._composition.meta
        if meta is not None:
            node.coordinator._composition.meta = replace(meta, seq=meta.seq + 1)
            fleet.publish(node, replace(meta, seq=meta.seq + 1))


class Reincarnation(_WordAttack):
    """Claims a new life with every beat."""

    is_detectable = False  # a robot that keeps crashing looks the same

    def say(self, fleet: Fleet, node: Node, message: Message, to: str) -> list[bytes]:
        if isinstance(message, Beat):
            message = replace(message, boot=fleet.rng.getrandbits(64))
        return [encode(message)]


_GHOST = TileMap.of(OccupancyGrid(np.full((64, 64), FREE, np.int8), 0.5))


class InventedRobot(_WordAttack):
    """Names a ghost as a member, says that it holds that map, and has an estate of it ready."""

    is_detectable = False  # nobody believes it, so nobody needs to prove it

    def say(self, fleet: Fleet, node: Node, message: Message, to: str) -> list[bytes]:
        if isinstance(message, Beat):
            meta = self.forged(node)
            return [encode(replace(message, global_digest=meta.id()) if meta else message)]
        if isinstance(message, GlobalMeta):
            return [encode(self.forged(node) or message)]
        return super().say(fleet, node, message, to)

    def answer(self, fleet: Fleet, node: Node, key: str, data: bytes | None) -> bytes | None:
        meta = self.forged(node)
        if meta is None or node.coordinator is None:
            return data
        if key == "global/meta":
            return encode(meta)
        if key.startswith("estate/ghost"):
            version, cells = MapVersion(1, 1, _GHOST.digest), TileDelta.between(None, _GHOST)
            return encode(Estate(node.robot, node.coordinator.boot, "ghost", 1, False, (), version, cells))
        return data

    def forged(self, node: Node) -> GlobalMeta | None:
        assert node.coordinator is not None
        data = node.coordinator.register("global/meta")
        meta = decode(data) if data else None
        if not isinstance(meta, GlobalMeta):
            return None
        ghost = replace(meta.members[0], robot="ghost", map=MapVersion(1, 1, _GHOST.digest))
        return replace(meta, members=(ghost, *meta.members))
