"""The one who looks after things now and then: saves the map, watches the links, answers the operator.

A link that Zenoh learnt by gossip is not dialled again after a cut, so when all known robots stay silent for long the
session is opened anew, with the configured seeds and the addresses learnt since (ZENOH.md, fact 8).
"""

from __future__ import annotations

import base64
import logging
import threading
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from agent.fleet.state import Presence
from agent.runtime import snapshot as snapshots
from agent.runtime.control import ControlError, Handler
from agent.runtime.drawn_features import DrawnFeatures
from agent.runtime.latest import Latest
from agent.runtime.memory import give_back_memory
from agent.runtime.metrics import metrics
from protocol.features import FeatureMap
from protocol.geometry import SE2
from protocol.grid import OccupancyGrid
from protocol.tiles import MAX_MAP_CELLS, pack_cells, unpack_cells

if TYPE_CHECKING:
    from agent.runtime.node import Node

log = logging.getLogger(__name__)

STEP_S = 0.5
REOPEN_AFTER_S = 20.0  # stalls of 10 s are normal and mean nothing
REOPEN_AT_MOST_EVERY_S = 300.0
CHECKPOINT_WITHIN_S = 1.0
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
        self._wait = threading.Event()
        self._silent_since_s: float | None = None
        self._reopen_after_s = REOPEN_AFTER_S
        self._next_open_s = 0.0
        self._next_give_back_s = 0.0
        self._seeds = tuple(node.config.fleet.connect)
        self._features = DrawnFeatures(self.grid)
        self.locators: list[str] = []
        self.links: list[str] = []

    def step(self) -> None:
        self._wait.wait(STEP_S)
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

    def save_now(self) -> None:
        """When stopping: the map worker has ended, so its mapper may be read here."""
        node = self._node
        self._save_memory(node.fleet.memory(), 0.0)
        if node.state is not None and node.map.scans:
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

    # The operator.

    def commands(self) -> Mapping[str, Handler]:
        return {
            "status": lambda _: {"status": self.status()},
            "pause": lambda _: self._pause(True),
            "resume": lambda _: self._pause(False),
            "reset": lambda _: self._reset(),
            "unmerge": lambda request: self._order("unmerge", request),
            "readmit": lambda request: self._order("readmit", request),
            "save": lambda _: self._save(),
            "map": self._map,
            "stop": lambda _: self._stop(),
        }

    def _pause(self, is_paused: bool) -> Mapping[str, Any]:
        self._node.map.is_paused = is_paused
        return {"message": "mapping is paused" if is_paused else "mapping goes on"}

    def _reset(self) -> Mapping[str, Any]:
        self._node.reset_map()
        return {"message": "a new local map begins; the old one is forgotten"}

    def _order(self, verb: str, request: Mapping[str, Any]) -> Mapping[str, Any]:
        peer = request.get("peer")
        known = [peer.robot for peer in self._node.fleet.state().peers]
        if not isinstance(peer, str) or peer not in known:
            raise ControlError(f"no peer {peer!r}; known are {', '.join(known) or 'none yet'}")
        self._node.fleet.order(verb, peer)
        return {"message": f"{peer} is taken out of our map until readmit" if verb == "unmerge" else f"{peer} may merge again"}

    def _save(self) -> Mapping[str, Any]:
        node = self._node
        if node.state is None:
            raise ControlError("this agent keeps no state: it was started without a state directory")
        self.ask_for_checkpoint()
        checkpoint = self._checkpoints.take(CHECKPOINT_WITHIN_S)
        if checkpoint is None:
            raise ControlError("the mapper did not answer in time; try again")
        if not node.state.save("mapper", checkpoint):
            raise ControlError(f"not saved: {node.state.last_error}")
        return {"message": f"saved {len(checkpoint)} bytes in {node.state.folder}"}

    def _map(self, request: Mapping[str, Any]) -> Mapping[str, Any]:
        """The cells of a map: "global", our own, or a peer's; see `unpacked_map`."""
        found = self.grid(str(request.get("name", snapshots.GLOBAL)))
        if found is None:
            raise ControlError(f"no map {request.get('name')!r}; there are {', '.join(snapshots.maps(self._node)) or 'none yet'}")
        version, grid = found
        return {"map": packed_map(version, grid)}

    def _stop(self) -> Mapping[str, Any]:
        self._node.stopping.set()
        return {"message": "stopping"}

    # What people and programs look at: also the source of the live page.

    def status(self) -> dict[str, Any]:
        status = snapshots.snapshot(self._node)
        status["facts"] = facts(status)
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


def packed_map(version: str, grid: OccupancyGrid) -> dict[str, Any]:
    """A map as JSON values."""
    return {
        "version": version,
        "height": grid.height,
        "width": grid.width,
        "resolution_m": grid.resolution_m,
        "origin": [grid.origin.x_m, grid.origin.y_m, grid.origin.theta_rad],
        "cells": base64.b64encode(pack_cells(grid.cells)).decode(),
    }


def unpacked_map(packed: Mapping[str, Any]) -> OccupancyGrid:
    cells = unpack_cells(base64.b64decode(packed["cells"]), packed["height"], packed["width"], MAX_MAP_CELLS)
    return OccupancyGrid(cells, packed["resolution_m"], SE2(*packed["origin"]))


def facts(status: Mapping[str, Any]) -> dict[str, str]:
    """The lines of "This robot" on the page."""
    mapping, network, fused = status["mapping"], status["network"], status["global"]
    lines = {
        "mapping": str(mapping.get("status", "waiting for the first scan")),
        "known": f"{mapping.get('known_m2', 0)} m²",
        "scans": f"{mapping['scans']} ({mapping['scans_lost']} lost)",
        "CPU per scan": f"{mapping['cpu_ms_per_scan']} ms" if mapping["cpu_ms_per_scan"] else "",
        **{d["name"]: f"{d['state']} {d['rate_hz']:.1f} Hz {d['model']}" for d in status["devices"]},
        "security": network["security"],
        "links": str(len(network["links"])),
        "sent": f"{(network['sent_bytes'] + network['served_bytes']) / 1024:.0f} KB",
        "received": f"{(network['received_bytes'] + network['pulled_bytes']) / 1024:.0f} KB",
    }
    if fused:
        lines["fleet map"] = f"{fused['known_m2']} m², {fused['conflicting_cells']} cells conflict"
    return {name: value for name, value in lines.items() if value}
