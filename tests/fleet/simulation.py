"""A whole fleet in one thread: the real coordinators and the real codec on a network that loses, delays, doubles and splits.

Everything is decided by one seed; a schedule that fails is replayed by its number.  Robots see a shared world of walls, each
in a map frame of its own; the matcher knows the true transforms but judges every transform on the cells themselves.
"""

from __future__ import annotations

import functools
import random
from collections.abc import Callable, Iterable

from agent.fleet.coordinator import Coordinator
from agent.fleet.effects import Changed, Effect, Fetch, Fuse, Match, MatchKind, Note, Send
from agent.fleet.memory import FleetMemory
from agent.fleet.options import FleetOptions
from agent.merging.fusion import FusedMap, fuse
from agent.merging.result import MergeResult
from protocol.channels import chunk_register
from protocol.codec import decode, encode
from protocol.errors import RemoteProtocolError
from protocol.geometry import SE2
from protocol.messages import Chunk, Manifest, Message
from tests.fleet.explorer import Explorer, judged
from tests.fleet.processes import Link, Node
from tests.fleet.timeline import Timeline

TICK_S = 0.2


Judge = Callable[["Fleet", Node, Match], MergeResult]


class Fleet(Timeline):
    """Robots and the network between them, and what the coordinators ask for."""

    def __init__(self, seed: int, *, link: Link | None = None, judge: Judge | None = None, is_encoded: bool = True) -> None:
        super().__init__()
        self.rng = random.Random(seed)
        self.link = link or Link()
        self.judge = judge or truthful
        self.is_encoded = is_encoded
        self._decode = decode if is_encoded else functools.lru_cache(maxsize=4_096)(decode)  # everybody reads the same object
        self.tick_s = TICK_S
        self.nodes: dict[str, Node] = {}
        self._by_robot: dict[str, list[Node]] = {}
        self.partition: dict[str, int] = {}
        self.blocked: set[tuple[str, str]] = set()  # one-way cuts
        self._fusions: dict[tuple[object, ...], FusedMap] = {}

    # Robots.

    def add(self, name: str, explorer: Explorer | None, options: FleetOptions | None = None, robot: str | None = None) -> Node:
        node = self.nodes[name] = Node(name, robot or name, explorer, options or FleetOptions())
        self._by_robot.setdefault(node.robot, []).append(node)
        self.start(node)
        return node

    def start(self, node: Node, memory: FleetMemory | None = None) -> None:
        node.life += 1
        node.coordinator = Coordinator(node.robot, self.rng.getrandbits(64), node.options)
        if memory is not None:
            node.coordinator.recall(memory)
        node.global_map = None
        if node.explorer is not None:
            self.share_map(node)
        self._tick(node, node.life)

    def crash(self, node: Node) -> None:
        node.coordinator, node.life = None, node.life + 1

    def share_map(self, node: Node) -> None:
        assert node.explorer is not None
        if node.coordinator is not None:
            self.carry_out(node, node.coordinator.on_local_map(node.explorer, node.explorer.features, self.local_s(node)))

    def local_s(self, node: Node) -> float:
        return self.now_s + node.clock_offset_s

    def _tick(self, node: Node, life: int) -> None:
        if node.life != life or node.coordinator is None:
            return
        self.carry_out(node, node.coordinator.tick(self.local_s(node)))
        self.at(self.tick_s * self.rng.uniform(0.9, 1.1), lambda: self._tick(node, life))

    # Effects.

    def carry_out(self, node: Node, effects: Iterable[Effect]) -> None:
        for effect in effects:
            match effect:
                case Send():
                    self.publish(node, effect.message)
                case Fetch():
                    self._fetch(node, effect)
                case Match():
                    self._match(node, effect)
                case Fuse():
                    self._fuse(node, effect)
                case Changed():
                    node.global_map = effect.global_map
                case Note():
                    node.notes.append(effect)

    def publish(self, node: Node, message: Message) -> None:
        """Offer a message to everybody; each link decides its fate."""
        data = encode(message)
        kind = type(message).__name__
        node.sent[kind] += len(data)
        node.messages[kind] += 1
        for other in self.nodes.values():
            if other is node or not self.connects(node.name, other.name):
                continue
            if node.tap is not None:
                for forged in node.tap.say(self, node, message, other.robot):
                    self.transmit(node, other, forged, None)
            else:
                self.transmit(node, other, data, message)

    def transmit(self, sender: Node, other: Node, data: bytes, message: Message | None) -> None:
        """One datagram on one link."""
        life = other.life
        for _ in range(1 + (self.rng.random() < self.link.duplicates)):
            if self.rng.random() >= self.link.loss:
                self.at(self.rng.uniform(*self.link.delay_s), lambda: self._deliver(sender, other, life, data, message))

    def _deliver(self, sender: Node, node: Node, life: int, data: bytes, message: Message | None) -> None:
        if node.coordinator is None or node.life != life:
            return
        node.received_messages += 1
        node.received_bytes += len(data)
        if message is None or self.is_encoded:
            try:
                message = decode(data)
                if message.robot != sender.robot:
                    raise RemoteProtocolError("a message in another's name")
            except RemoteProtocolError as error:
                self.carry_out(node, node.coordinator.on_garbage(sender.robot, str(error), self.local_s(node)))
                return
        self.carry_out(node, node.coordinator.on_message(message, self.local_s(node)))

    def _fetch(self, node: Node, fetch: Fetch) -> None:
        """As the runtime does: a silent question is asked again after 1.5 s, and given up after 6 s."""
        life, is_over = node.life, False

        def ask(times: int) -> None:
            if is_over or times > 4:
                end(None)
                return
            if self.rng.random() >= self.link.loss:
                self.at(2 * self.rng.uniform(*self.link.delay_s), lambda: end(self._pull(node, fetch), is_last=times == 4))
            self.at(1.5, lambda: ask(times + 1))

        def end(message: Message | None, *, is_last: bool = True) -> None:
            nonlocal is_over
            if is_over or (message is None and not is_last):
                return
            is_over = True
            if node.life == life and node.coordinator is not None:
                self.carry_out(node, node.coordinator.on_fetched(fetch, message, self.local_s(node)))

        ask(1)

    def _pull(self, node: Node, fetch: Fetch) -> Message | None:
        reached = [peer for peer in self.processes(fetch.peer) if self.connects(node.name, peer.name)]
        if not reached:
            return None
        peer = self.rng.choice(reached)
        assert peer.coordinator is not None
        if self.rng.random() < self.link.loss:
            return None
        data = self._ask(peer, fetch.key)
        if data is None:
            return None
        try:
            message = self._decode(data)
            if isinstance(message, Manifest):
                parts = []
                for i in range(message.chunks):
                    piece = self._ask(peer, chunk_register(message.digest, i))
                    chunk = decode(piece) if piece else None
                    if not isinstance(chunk, Chunk):
                        return None
                    parts.append(chunk.data)
                data = b"".join(parts)
                message = self._decode(data)
        except RemoteProtocolError:
            return None
        node.pulled_bytes += len(data)
        peer.sent[type(message).__name__] += len(data)
        peer.messages[type(message).__name__] += 1
        return message

    def _ask(self, peer: Node, key: str) -> bytes | None:
        assert peer.coordinator is not None
        data = peer.coordinator.register(key)
        return data if peer.tap is None else peer.tap.answer(self, peer, key, data)

    def _match(self, node: Node, job: Match) -> None:
        life = node.life

        def finish() -> None:
            if node.life == life and node.coordinator is not None:
                result = self.judge(self, node, job)
                self.carry_out(node, node.coordinator.on_match_done(job, result, self.local_s(node)))

        self.at(self.rng.uniform(0.02, 0.2), finish)

    def _fuse(self, node: Node, job: Fuse) -> None:
        life = node.life

        def finish() -> None:
            if node.life == life and node.coordinator is not None:
                fused = self._fused(job)
                self.carry_out(node, node.coordinator.on_fused(job, fused, self.local_s(node)))

        self.at(self.rng.uniform(0.02, 0.2), finish)

    def _fused(self, job: Fuse) -> FusedMap:
        """`fuse`, once for all robots that follow one recipe: it is a pure function."""
        key = (job.resolution_m, *((grid.content_hash(), T) for grid, T in job.maps))
        if key not in self._fusions:
            self._fusions[key] = fuse(job.maps, job.resolution_m)
        return self._fusions[key]

    # The network.

    def processes(self, robot: str) -> list[Node]:
        """Everything that runs under one robot id: one, unless there are twins."""
        return [node for node in self._by_robot.get(robot, []) if node.is_up]

    def connects(self, a: str, b: str) -> bool:
        return self.partition.get(a, 0) == self.partition.get(b, 0) and (a, b) not in self.blocked

    def split(self, *sides: Iterable[str]) -> None:
        self.partition = {name: i + 1 for i, side in enumerate(sides) for name in side}

    def heal(self) -> None:
        self.partition, self.blocked = {}, set()

    # What holds.

    def true_T(self, a: str, b: str) -> SE2:
        """T_a_b of the two map frames."""
        first, second = self.nodes[a].explorer, self.nodes[b].explorer
        assert first is not None and second is not None
        return first.T_world_map.inverse() @ second.T_world_map

    def digests(self) -> dict[str, str]:
        return {
            node.name: node.global_map.digest.hex()[:8] if node.global_map else "-" for node in self.nodes.values() if node.is_up
        }

    def agrees(self, names: Iterable[str]) -> bool:
        """Whether these robots hold one and the same global map of exactly them."""
        maps = [self.nodes[name].global_map for name in names]
        first = maps[0]
        if first is None or {member.robot for member in first.members} != set(names):
            return False
        return all(other is not None and other.digest == first.digest and other.members == first.members for other in maps)

    def describe(self) -> str:
        lines = [f"{super().describe()} digests={self.digests()}"]
        for node in self.nodes.values():
            if node.coordinator is not None:
                state = node.coordinator.state(self.local_s(node))
                pairs = {p.robot: (p.pair, p.presence.value, p.reason) for p in state.peers}
                lines.append(f"  {node.name}: composer={state.composer} root={state.root} frames={sorted(state.frames)} {pairs}")
        return "\n".join(lines)


def truthful(fleet: Fleet, node: Node, job: Match) -> MergeResult:
    """The true transform where the cells bear it out; verification of any transform on the cells."""
    T = job.T_ours_theirs if job.kind is MatchKind.VERIFY else fleet.true_T(node.robot, job.peer)
    assert T is not None
    return judged(job.ours, job.theirs, T)
