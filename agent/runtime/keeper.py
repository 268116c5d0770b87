"""The one who looks after things now and then: saves the map, watches the links, and tells who looks how it all is.

A link that Zenoh learnt by gossip is not dialled again after a cut, so when all known robots stay silent for long the
session is opened anew, with the configured seeds (ZENOH.md, fact 8).
"""

from __future__ import annotations

import logging
import time
from typing import TYPE_CHECKING, Any

from agent.fleet.state import Presence
from agent.runtime import snapshot as snapshots
from agent.runtime.drawn_features import DrawnFeatures
from agent.runtime.latest import Latest
from agent.runtime.memory import give_back_memory
from agent.runtime.metrics import metrics
from agent.runtime.page_lines import page_lines
from protocol.features import FeatureMap
from protocol.grid import OccupancyGrid

if TYPE_CHECKING:
    from agent.runtime.node import Node

log = logging.getLogger(__name__)

STEP_S = 0.5
REOPEN_AFTER_S = 20.0  # stalls of 10 s are normal and mean nothing
REOPEN_AT_MOST_EVERY_S = 300.0
MEMORY_EVERY_S = 2.0  # a transform that is refined all the time does not wear the disk out
GIVE_BACK_EVERY_S = 3.0  # 2 ms each
OPEN_EVERY_S = 2.0  # a client looks for its router this often


class Keeper:
    """Runs beside the workers; owns nothing that another worker needs."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._checkpoints: Latest[bytes] = Latest()
        self._next_save_s = time.monotonic() + node.config.state.save_every_s
        self._memory, self._memory_s = b"", time.monotonic()
        self._silent_since_s: float | None = None
        self._reopen_after_s = REOPEN_AFTER_S
        self._next_open_s = 0.0
        self._next_give_back_s = 0.0
        self._seeds = tuple(node.config.fleet.connect)
        self._features = DrawnFeatures(self.grid)
        self.locators: list[str] = []
        self.links: list[str] = []

    def step(self) -> None:
        self._node.stopping.wait(STEP_S)
        node = self._node
        if not self.locators and node.fleet.exchange.is_open:
            self.locators = node.fleet.exchange.locators()
        self.links = node.fleet.exchange.links()
        self._watch_links()
        if time.monotonic() >= self._next_give_back_s:
            self._next_give_back_s = time.monotonic() + GIVE_BACK_EVERY_S
            give_back_memory()
        self.save_checkpoint()
        self._save_memory(node.fleet.memory(), MEMORY_EVERY_S)
        if node.state is not None and time.monotonic() >= self._next_save_s:
            self._next_save_s = time.monotonic() + node.config.state.save_every_s
            self.ask_for_checkpoint()

    def ask_for_checkpoint(self) -> None:
        """The map worker makes one between two scans; `save_checkpoint` puts it on disk."""
        self._node.map.call(lambda: self._checkpoints.put(self._node.map.mapper.checkpoint()))

    def drop_checkpoint(self) -> None:
        """One that was made and not saved yet is of a map that is gone."""
        self._checkpoints.take()

    def save_checkpoint(self) -> None:
        """Save what the map worker made, if it did."""
        checkpoint = self._checkpoints.take()
        if checkpoint is not None and self._node.state is not None:
            self._node.state.save("mapper", checkpoint)

    def _save_memory(self, memory: bytes, every_s: float) -> None:
        """Where the others lie on our map: small, and written whenever it is another."""
        state, now_s = self._node.state, time.monotonic()
        if state is not None and memory != self._memory and now_s - self._memory_s >= every_s:
            self._memory_s = now_s
            if state.save("fleet", memory):
                self._memory = memory

    def save_now(self, *, is_map_at_rest: bool) -> None:
        """When stopping: a mapper whose worker has ended may be read here; of one that works on, what was saved last stands."""
        node = self._node
        self._save_memory(node.fleet.memory(), 0.0)
        if not is_map_at_rest:
            log.warning("the map is still being worked on and is not saved; what was saved before stands")
        elif node.state is not None and node.map.scans:
            node.state.save("mapper", node.map.mapper.checkpoint())

    def _watch_links(self) -> None:
        """Open the session anew when every robot we know has been silent for long, or nobody is linked at all."""
        node, now = self._node, time.monotonic()
        if not node.fleet.exchange.is_open:
            if now >= self._next_open_s:
                self._next_open_s = now + OPEN_EVERY_S
                node.fleet.exchange.reopen(self._seeds)
            return
        peers = node.fleet.state().peers
        is_alone = (
            bool(peers or self._seeds)
            and all(peer.presence is not Presence.ALIVE for peer in peers)
            and (bool(peers) or not self.links)
        )
        if not is_alone:
            self._silent_since_s, self._reopen_after_s = None, REOPEN_AFTER_S
            return
        if self._silent_since_s is None:
            self._silent_since_s = now
        if now - self._silent_since_s > self._reopen_after_s:
            log.warning("network: silence for %.0f s, opening the session anew", now - self._silent_since_s)
            self._silent_since_s, self._reopen_after_s = now, min(2 * self._reopen_after_s, REOPEN_AT_MOST_EVERY_S)
            node.fleet.exchange.reopen(self._seeds)

    # What people and programs look at: also the source of the live page.

    def status(self) -> dict[str, Any]:
        status = snapshots.snapshot(self._node)
        status["facts"] = page_lines(status)
        return status

    def grid(self, name: str) -> tuple[str, OccupancyGrid] | None:
        return snapshots.grid_of(self._node, name)

    def features(self, name: str) -> FeatureMap | None:
        return self._features.of(name)

    def metrics(self) -> str:
        """The same for Prometheus."""
        return metrics(self.status())

    def summary(self) -> str:
        """One line for the service manager."""
        mapping, group = snapshots.mapping(self._node), len(self._node.fleet.state().frames)
        return f"{mapping['scans']} scans, {mapping.get('known_m2', 0)} m2, group of {max(1, group)}"
