"""A given map is a peer: it takes part in the fleet like a robot that stands still and knows its place.

Finding oneself in it (the paper's global localization, the kidnapped robot) is then nothing but merging with it.  It has
a Zenoh session of its own in this process, so that the rest of the fleet meets it as well.
"""

from __future__ import annotations

import secrets
from dataclasses import dataclass, replace
from pathlib import Path

from agent.features.snapshot import MapSnapshot
from agent.fleet.coordinator import Coordinator
from agent.fleet.options import FleetOptions
from agent.map_files import load_map
from agent.runtime.fleet_worker import FleetWorker
from agent.runtime.guard import guard_for
from agent.runtime.merge_worker import MergeWorker
from agent.runtime.network import NetworkSettings
from agent.runtime.worker import Worker
from protocol.geometry import SE2
from protocol.grid import OccupancyGrid

MAX_NAME_CHARS = 32


@dataclass(frozen=True, slots=True, eq=False)
class GivenMap:
    """What the fleet logic needs of a map that nobody draws any more."""

    grid: OccupancyGrid
    T_map_robot: SE2 = SE2(0.0, 0.0, 0.0)
    epoch: int = 0


class FrozenPeer:
    """One given map in the fleet."""

    def __init__(self, path: Path, number: int, settings: NetworkSettings, merger: MergeWorker, options: FleetOptions) -> None:
        suffix = f"-prior{number}"
        self.name = settings.robot[: MAX_NAME_CHARS - len(suffix)] + suffix
        self.path = path
        self._grid = load_map(path)
        self._settings = replace(settings, robot=self.name, holder=settings.robot, listen=(), is_router=False)
        boot_id = secrets.randbits(63)
        coordinator = Coordinator(self.name, boot_id, replace(options, is_frozen=True))
        self.fleet = FleetWorker(coordinator, self._settings, merger, guard_for(self._settings, boot_id))

    def workers(self) -> list[Worker]:
        """Rows for the node's table."""
        return [
            Worker(f"{self.name}", self.fleet.step, 5.0, "messages, results, time", "messages, jobs"),
            Worker(f"{self.name}-bulk", self.fleet.bulk_step, 60.0, "fetches", "pulled messages"),
            Worker(f"{self.name}-small", self.fleet.small_step, 60.0, "fetches", "pulled messages"),
        ]

    def open(self, locators: tuple[str, ...]) -> None:
        """Join the fleet by dialling our own robot, or its router."""
        exchange = self.fleet.exchange
        if self._settings.mode != "client":
            exchange.settings = replace(exchange.settings, connect=locators)
        exchange.open()
        self.fleet.local_maps.put((GivenMap(self._grid), MapSnapshot.of(self._grid).features))

    def close(self) -> None:
        self.fleet.exchange.close()
