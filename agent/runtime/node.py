"""One robot's process: the workers, what flows between them, and how they start and stop.

worker     reads                     writes                    deadline
lidar      LIDAR device              readings                  5 s
wheels     wheel device              readings                  5 s
map        readings                  estimates                 10 s
features   estimates                 own map, for the fleet    20 s
fleet      messages, results, time   messages, jobs            5 s
pull-*     fetches                   pulled messages           60 s
merge      match and fuse jobs       results                   120 s
keeper     everything, to look       disk, links               30 s
*-prior*   as fleet and pull, for a given map

Values only flow to the right and down; every arrow is a mailbox that never grows.  The main thread feeds the watchdog.
"""

from __future__ import annotations

import logging
import secrets
import threading
import time
from collections.abc import Callable
from pathlib import Path

from agent.config import Config
from agent.features.snapshot import MapSnapshot
from agent.fleet.coordinator import Coordinator
from agent.fleet.memory import FleetMemory, decode_memory
from agent.fleet.options import FleetOptions
from agent.mapping.estimate import MapEstimate
from agent.mapping.mapper import Mapper
from agent.runtime.control import ControlServer
from agent.runtime.exchange import Exchange
from agent.runtime.fleet_worker import FleetWorker
from agent.runtime.guard import guard_for
from agent.runtime.health import Health, Notifier, watchdog_period_s
from agent.runtime.keeper import Keeper
from agent.runtime.map_worker import MapWorker
from agent.runtime.merge_worker import MergeWorker
from agent.runtime.orders import Orders
from agent.runtime.own_loops import fit_in_own_map
from agent.runtime.pace import REAL, Pace
from agent.runtime.priors import FrozenPeer
from agent.runtime.records import Records
from agent.runtime.sensing import Readings, device_step
from agent.runtime.settings import mapping_options, match_options, network_settings, wheels_url
from agent.runtime.state import StateDirectory
from agent.runtime.worker import Worker, WorkerReport
from hw.device import Source, open_lidar, open_wheels

log = logging.getLogger(__name__)

STOP_WITHIN_S = 1.5  # what the workers have to come back; the whole stop stays below 2 s


class Node:
    """A running robot.  Use with `with`: leaving stops every thread and closes every device, whatever happened."""

    def __init__(
        self,
        config: Config,
        state_folder: Path | None,
        control_socket: Path | None,
        *,
        boot_id: int | None = None,
        pace: Pace = REAL,
        exchange: Callable[..., Exchange] = Exchange,
    ) -> None:
        self.config = config
        self.robot = config.robot.id
        self.boot_id = secrets.randbits(63) if boot_id is None else boot_id
        self._pace = pace
        self._unread: MapEstimate | None = None  # the newest map whose features were not made yet
        self._snapshot: MapSnapshot | None = None  # the newest of which they were
        self._next_features_s = 0.0
        self.started_s = time.monotonic()
        self.state = StateDirectory(state_folder) if state_folder is not None else None
        self.records = Records(state_folder / "records.jsonl" if state_folder is not None else None)
        self.lidar: Source = open_lidar(config.lidar.url)
        self.wheels: Source | None = open_wheels(wheels_url(config)) if config.wheels.url else None
        self.readings = Readings()
        self.map = MapWorker(self._mapper(), self.readings, pace=pace)
        self.merger = MergeWorker(match_options(config), pace)
        options = FleetOptions(min_match_factor=config.matching.min_match_factor)
        self._features_period_s = options.announce_period_s  # what comes sooner is not announced
        coordinator = Coordinator(self.robot, self.boot_id, options)
        coordinator.recall(decode_memory((self.state and self.state.load("fleet")) or b"") or FleetMemory())
        settings = network_settings(config)
        guard = guard_for(settings, self.boot_id)
        self.fleet = FleetWorker(
            coordinator, settings, self.merger, guard, on_note=self.records.add, pace=pace, exchange=exchange
        )
        given = enumerate(map(Path, config.fleet.priors), start=1)
        self.priors = [FrozenPeer(path, number, settings, self.merger, options) for number, path in given]
        self.keeper = Keeper(self)
        self.workers = self._workers()
        self.health = Health(self.reports, Notifier())
        self.control = ControlServer(control_socket, Orders(self).commands()) if control_socket is not None else None
        self.stopping = threading.Event()

    def _workers(self) -> list[Worker]:
        """The table above, in the order in which they start; they stop in the reverse order."""
        row = Worker
        table = [
            row("merge", self.merger.step, 120.0, "match and fuse jobs", "results"),
            row("fleet", self.fleet.step, 5.0, "messages, results, time", "messages, jobs"),
            # A silent peer holds one puller up for 5 s; the others go on.
            *(row(f"pull-bulk-{i}", self.fleet.bulk_step, 60.0, "fetches", "pulled messages") for i in (1, 2)),
            *(row(f"pull-small-{i}", self.fleet.small_step, 60.0, "fetches", "pulled messages") for i in (1, 2, 3)),
            row("features", self._features_step, 20.0, "estimates", "own map, for the fleet"),
            row("map", self.map.step, 10.0, "readings", "estimates"),
            row(
                "lidar",
                device_step(self.lidar, self.readings, is_upside_down=self.config.lidar.is_upside_down),
                5.0,
                "LIDAR device",
                "readings",
            ),
            row("keeper", self.keeper.step, 30.0, "everything, to look", "disk, links"),
        ]
        if self.wheels is not None:
            table.append(row("wheels", device_step(self.wheels, self.readings), 5.0, "wheel device", "readings"))
        return table + [worker for prior in self.priors for worker in prior.workers()]

    def _mapper(self) -> Mapper:
        """Where the last run stopped when its map is on disk and sound, else a new one."""
        options = mapping_options(self.config)
        saved = self.state.load("mapper") if self.state is not None else None
        if saved is not None:
            try:
                mapper = Mapper.restore(saved, options, fit_in_own_map)
                log.info("restored the local map of the last run bytes=%d", len(saved))
                return mapper
            except Exception as error:  # whatever an older program wrote: a robot starts
                log.warning("the saved map does not fit this program, starting a new one: %s", error)
        return Mapper(options, self.config.mapping.seed, fit_in_own_map)

    def _features_step(self) -> None:
        """Where we are, as often as it is known; the map and its features, as often as they are announced."""
        estimate = self.map.estimates.take(self._pace.wait_s(0.25))
        if estimate is not None:
            self.fleet.poses.put(estimate.T_map_robot)
            self._unread = estimate
        if self._unread is not None and self._pace.clock() >= self._next_features_s:
            estimate, self._unread = self._unread, None
            self._next_features_s = self._pace.clock() + self._features_period_s
            self._snapshot = self._snapshot.updated(estimate.grid) if self._snapshot else MapSnapshot.of(estimate.grid)
            self.fleet.local_maps.put((estimate, self._snapshot.features))

    def __enter__(self) -> Node:
        try:
            self.fleet.exchange.open()
            for prior in self.priors:
                prior.open(tuple(self.fleet.exchange.locators()))
            if self.control is not None:
                self.control.start()
            self.lidar.start()
            if self.wheels is not None:
                self.wheels.start()
            for worker in self.workers:
                worker.start()
        except BaseException:
            self.stop()
            raise
        self.health.look("starting")
        Notifier().send("READY=1")
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def run(self, on_turn: Callable[[], bool] = lambda: True) -> None:
        """Until `stopping` is set or `on_turn` says False: feed the watchdog while every worker makes progress."""
        while not self.stopping.wait(watchdog_period_s()) and on_turn():
            before = self.health.stuck
            self.health.look(self.keeper.summary())
            if self.health.stuck and self.health.stuck != before:
                log.error("no progress: %s; the watchdog is not fed", ", ".join(self.health.stuck))

    def stop(self) -> None:
        """Everything ends, in the reverse order of starting; the map is saved last."""
        self.stopping.set()
        Notifier().send("STOPPING=1")
        started = time.monotonic()
        for worker in self.workers:
            worker.ask_to_stop()
        for fleet in (self.fleet, *(prior.fleet for prior in self.priors)):
            fleet.exchange.stop_waiting()
        if self.control is not None:
            self.control.close()
        left = [w.name for w in reversed(self.workers) if not w.join(STOP_WITHIN_S - (time.monotonic() - started))]
        for name in left:
            log.warning("worker=%s does not stop, left behind", name)
        self.keeper.save_now(is_map_at_rest="map" not in left)
        for device in (self.lidar, self.wheels):
            if device is not None:
                device.stop()
        for prior in self.priors:
            prior.close()
        self.fleet.exchange.close()

    def reset_map(self) -> None:
        """Begin a new local map in a new frame; peers learn from its epoch that the old one is gone."""

        def begin() -> None:
            epoch = self.map.mapper.epoch + 1
            self.map.mapper = Mapper(mapping_options(self.config), self.config.mapping.seed, fit_in_own_map)
            self.map.mapper.epoch = epoch
            self.keeper.drop_checkpoint()
            if self.state is not None:
                self.state.forget("mapper")
                self.state.forget("fleet")

        self.map.call(begin)

    def reports(self) -> list[WorkerReport]:
        return [worker.report() for worker in self.workers]
