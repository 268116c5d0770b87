"""What this robot says of itself, unasked: a beat with the versions of everything, an announcement when its map has grown."""

from __future__ import annotations

import hashlib
import random
import struct

from agent.fleet.composition import Composition
from agent.fleet.consistency import is_same_drawing
from agent.fleet.ledger import Ledger, statements_digest
from agent.fleet.pairs import PairWork
from agent.fleet.state import Presence
from agent.fleet.timetable import NEVER_S
from protocol.channels import MAJOR_VERSION
from protocol.features import FeatureMap
from protocol.geometry import SE2
from protocol.grid import OccupancyGrid
from protocol.messages import NO_DIGEST, Beat, Hello, Statements

SOFTWARE = "mapquilt"


class OwnWords:
    """Beats, introductions and announcements."""

    def __init__(self, ledger: Ledger, pairs: PairWork, composition: Composition) -> None:
        self._ledger, self._pairs, self._composition = ledger, pairs, composition
        self._rng = random.Random(f"{ledger.robot}/{ledger.boot}/{ledger.options.seed}")
        self._latest: tuple[OccupancyGrid, FeatureMap, int] | None = None  # not yet published
        self._announced_m2 = 0.0
        self._beat_seq = 0
        self.epoch = 0  # of the map we published last, be it in a life before
        self.recalled_epoch: int | None = None  # of the map that remembered transforms are about
        self.T_map_robot: SE2 | None = None

    def take_map(self, grid: OccupancyGrid, features: FeatureMap, epoch: int, now_s: float) -> None:
        """A newer state of our own map, announced when it is time."""
        self._latest = (grid, features, epoch)
        self.announce(now_s)

    def announce(self, now_s: float) -> None:
        """Publish the newest state of our own map, not too often."""
        if self._latest is None or now_s < self._ledger.timetable.next_announce_s:
            return
        (grid, features, epoch), self._latest = self._latest, None
        own = self._ledger.own
        before, drawn_before = own.version, own.grid
        if self.recalled_epoch not in (None, epoch):
            self._pairs.words.remembered, self.recalled_epoch = {}, None
        self.epoch = epoch
        if not own.publish(grid, features, frame_id(self._ledger.robot, self._ledger.boot, epoch)):
            return
        self._ledger.timetable.next_announce_s = now_s + self._ledger.options.announce_period_s
        assert own.version is not None and own.announcement is not None
        if before is not None and before.frame != own.version.frame:
            self._pairs.on_new_frame(self._ledger.robot, now_s)
            if drawn_before is not None and own.grid is not None and not is_same_drawing(drawn_before, own.grid):
                self._pairs.words.forget_hints()
        is_new_frame = before is None or before.frame != own.version.frame
        if is_new_frame or own.known_area_m2 > self._announced_m2 * (1.0 + self._ledger.options.announce_growth):
            self._announced_m2 = own.known_area_m2
            self._ledger.send(own.announcement)
        self._ledger.timetable.next_scan_s = min(self._ledger.timetable.next_scan_s, now_s)

    def beat(self, now_s: float) -> None:
        """Say that we are here, with the version of everything we hold; in large fleets less often."""
        ledger, options = self._ledger, self._ledger.options
        heard = sum(peer.presence is not Presence.LOST for peer in ledger.peers.values())
        period_s = max(options.beat_period_s, heard / options.max_beats_per_s)
        ledger.timetable.next_beat_s = now_s + period_s * (1.0 + options.beat_jitter * self._rng.uniform(-1.0, 1.0))
        self._beat_seq += 1
        ledger.send(self._beat(period_s))
        if ledger.timetable.next_hello_s <= now_s:
            ledger.timetable.next_hello_s = NEVER_S
            ledger.send(self.hello())

    def _beat(self, period_s: float) -> Beat:
        ledger, held = self._ledger, self._composition.global_map
        return Beat(
            ledger.robot,
            ledger.boot,
            self._beat_seq,
            ledger.clock.now_s,
            period_s,
            ledger.own.version,
            statements_digest(ledger.mine.values()),
            held.id() if held else NO_DIGEST,
            self.T_map_robot,
            ledger.options.is_frozen,
            0.0,
            ledger.own.known_area_m2,
        )

    def hello(self) -> Hello:
        """Who we are: software, versions, resolution."""
        ledger, own = self._ledger, self._ledger.own
        resolution_m = own.tiles.resolution_m if own.tiles else 0.05
        return Hello(
            ledger.robot,
            ledger.boot,
            ledger.clock.now_s,
            MAJOR_VERSION,
            MAJOR_VERSION,
            SOFTWARE,
            resolution_m,
            ledger.options.is_frozen,
        )

    def statements(self) -> Statements:
        """Everything we say about pairs."""
        mine = sorted(self._ledger.mine.values(), key=lambda statement: statement.other)
        return Statements(self._ledger.robot, self._ledger.boot, self._ledger.seq, tuple(mine))


def frame_id(robot: str, boot: int, epoch: int) -> int:
    """The name of a map frame: no other robot, boot or epoch has the same."""
    return int.from_bytes(hashlib.sha256(f"{robot}/{epoch}".encode() + struct.pack("<Q", boot)).digest()[:8], "little")
