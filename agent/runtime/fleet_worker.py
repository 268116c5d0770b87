"""Drives one robot's fleet logic: everything that comes in goes through the coordinator, its effects are carried out.

The coordinator knows no thread; here a lock makes its callers take turns (this worker, the answering thread, the operator).
"""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable, Iterable
from typing import Any

from agent.fleet.coordinator import Coordinator, LocalMap
from agent.fleet.effects import Changed, Effect, Fetch, Fuse, Match, Note, Send
from agent.fleet.state import FleetState
from agent.runtime.exchange import Exchange
from agent.runtime.guard import Guard, OpenGuard
from agent.runtime.latest import Latest
from agent.runtime.merge_worker import Done, Matched, MergeWorker
from agent.runtime.network import NetworkSettings
from agent.runtime.pace import REAL, Pace
from agent.runtime.pulling import Pull
from protocol.channels import BY_KIND, parse_key, push_register, robot_key, subscriptions
from protocol.codec import decode, encode
from protocol.errors import LocalProtocolError, RemoteProtocolError
from protocol.features import FeatureMap
from protocol.geometry import SE2
from protocol.grid import OccupancyGrid
from protocol.messages import GlobalMap, Message

log = logging.getLogger(__name__)

TICK_S = 0.1
WAIT_S, PULL_WAIT_S = 0.05, 0.25


class FleetWorker:
    """One coordinator, its exchange, and the threads that pull for it."""

    def __init__(
        self,
        coordinator: Coordinator,
        settings: NetworkSettings,
        merger: MergeWorker,
        guard: Guard | None = None,
        on_note: Callable[[Note], None] | None = None,
        pace: Pace = REAL,
        exchange: Callable[..., Exchange] = Exchange,
    ) -> None:
        self.settings, self._pace = settings, pace
        self.exchange = exchange(
            settings, self._register, subscriptions(settings.fleet), robot_key(settings.fleet, settings.robot, "**")
        )
        self.local_maps: Latest[tuple[LocalMap, FeatureMap]] = Latest()
        self.poses: Latest[SE2] = Latest()
        self.garbage = 0  # messages that no robot of ours sends
        self.global_map: GlobalMap | None = None
        self._coordinator, self._merger, self._on_note = coordinator, merger, on_note
        self._guard: Guard = guard or OpenGuard()
        self._turn = threading.Lock()
        self._results: queue.SimpleQueue[Done | tuple[Fetch, Message | None]] = queue.SimpleQueue()
        self._small: queue.Queue[Fetch] = queue.Queue(maxsize=64)
        self._bulk: queue.Queue[Fetch] = queue.Queue(maxsize=16)
        self._next_tick_s = 0.0

    # The workers.

    def step(self) -> None:
        """One message, whatever results wait, our own map when it changed, and the tick when it is time."""
        taken = self.exchange.inbox.take(self._pace.wait_s(WAIT_S))
        if taken is not None:
            self._on_bytes(*taken)
        while not self._results.empty():
            self._on_result(self._results.get())
        local = self.local_maps.take()
        if local is not None:
            self._do(lambda now_s: self._coordinator.on_local_map(local[0], local[1], now_s))
        pose = self.poses.take()
        if pose is not None:
            with self._turn:
                self._coordinator.on_pose(pose, self._pace.clock())
        if self._pace.clock() >= self._next_tick_s:
            self._next_tick_s = self._pace.clock() + TICK_S
            self._do(self._coordinator.tick)

    def waiting(self) -> int:
        """Words, results and fetches that nobody has looked at yet."""
        return len(self.exchange.inbox) + self._results.qsize() + self._small.qsize() + self._bulk.qsize()

    def small_step(self) -> None:
        self._pull_from(self._small)

    def bulk_step(self) -> None:
        self._pull_from(self._bulk)

    def _pull_from(self, fetches: queue.Queue[Fetch]) -> None:
        try:
            fetch = fetches.get(timeout=self._pace.wait_s(PULL_WAIT_S))
        except queue.Empty:
            return
        message: Message | None = None
        try:
            pull = Pull(self.exchange, self._guard, self.settings.fleet, fetch.peer, self.exchange.closed)
            message = pull.run(fetch.key, is_bulk=fetch.is_bulk)
        finally:
            self._results.put((fetch, message))

    # What comes in.

    def _on_bytes(self, key: str, payload: bytes) -> None:
        try:
            fleet, robot, register = parse_key(key)
        except RemoteProtocolError:
            return
        if fleet != self.settings.fleet:
            return
        try:
            message = decode(self._guard.open(payload, robot))
            if message.robot != robot or push_register(message) != register:
                raise RemoteProtocolError(f"a message of {message.robot} on {register} of {robot}")
        except (RemoteProtocolError, LocalProtocolError) as error:
            self._on_garbage(robot, str(error))
            return
        self._do(lambda now_s: self._coordinator.on_message(message, now_s))

    def _on_garbage(self, robot: str, reason: str) -> None:
        """Only a certificate proves who wrote on a key: without one, garbage must not speak against the robot it names."""
        self.garbage += 1
        if self.settings.security == "mtls":
            self._do(lambda now_s: self._coordinator.on_garbage(robot, reason, now_s))
        if str(self.garbage).strip("0") == "1":  # the 1st, 10th, 100th, ...: a flood does not fill the log
            log.warning("garbage key=%s messages=%d reason=%s", robot, self.garbage, reason)

    def _on_result(self, result: Done | tuple[Fetch, Message | None]) -> None:
        if isinstance(result, tuple):
            fetch, message = result
            self._do(lambda now_s: self._coordinator.on_fetched(fetch, message, now_s))
        elif isinstance(result, Matched):
            self._do(lambda now_s: self._coordinator.on_match_done(result.job, result.result, now_s))
        else:
            self._do(lambda now_s: self._coordinator.on_fused(result.job, result.result, now_s))

    def _register(self, key: str) -> bytes | None:
        """The answer to a query, on the answering thread."""
        try:
            _, robot, register = parse_key(key)
        except RemoteProtocolError:
            return None
        if robot != self.settings.robot:
            return None
        with self._turn:
            content = self._coordinator.register(register)
        return None if content is None else self._guard.seal(content)

    # What goes out.

    def _do(self, call: Callable[[float], Iterable[Effect]]) -> None:
        with self._turn:
            effects = list(call(self._pace.clock()))
        for effect in effects:
            self._carry_out(effect)

    def _carry_out(self, effect: Effect) -> None:
        if isinstance(effect, Send):
            self._publish(effect.message)
        elif isinstance(effect, Fetch):
            try:
                (self._bulk if effect.is_bulk else self._small).put_nowait(effect)
            except queue.Full:
                self._results.put((effect, None))
        elif isinstance(effect, Match | Fuse):
            self._merger.submit(effect, self._results.put)
        elif isinstance(effect, Changed):
            self.global_map = effect.global_map
        else:
            self._note(effect)

    def _publish(self, message: Message) -> None:
        channel = BY_KIND[type(message)]
        try:
            payload = self._guard.seal(encode(message))
        except LocalProtocolError:
            log.exception("fleet: a message of ours cannot travel")
            return
        key = robot_key(self.settings.fleet, self.settings.robot, push_register(message))
        self.exchange.put(key, payload, channel.urgency.value, is_express=channel.is_express)

    def _note(self, note: Note) -> None:
        facts = " ".join(
            f"{name}={value:.3f}" if isinstance(value, float) else f"{name}={value}" for name, value in note.facts.items()
        )
        log.log(logging.WARNING if note.is_warning else logging.INFO, "%s %s", note.event, facts)
        if self._on_note is not None:
            self._on_note(note)

    # For the disk.

    def memory(self) -> bytes:
        """What a next life should know of this one."""
        with self._turn:
            return self._coordinator.memory().encode()

    # For people.

    def state(self) -> FleetState:
        with self._turn:
            return self._coordinator.state(self._pace.clock())

    def peer_maps(self) -> dict[str, tuple[bytes, OccupancyGrid]]:
        """(digest, cells) of the newest map that is here of each peer."""
        with self._turn:
            return self._coordinator.peer_maps()

    def order(self, verb: str, peer: str) -> None:
        """`unmerge` or `readmit` a peer, as the operator wishes."""
        call: Any = {"unmerge": self._coordinator.unmerge, "readmit": self._coordinator.readmit}[verb]
        self._do(lambda now_s: call(peer, now_s))
