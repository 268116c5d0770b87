"""A listener on a fleet: it hears the robots, pulls their maps and the fleet's, and says nothing.

It shows the same page as a robot does, from what the robots themselves say: their beats, the global map of the largest
group, their own maps, and their statements about one another.
"""

from __future__ import annotations

import secrets
import time
from collections import deque
from dataclasses import dataclass
from typing import Any

from agent.runtime.drawn_features import DrawnFeatures
from agent.runtime.exchange import Exchange
from agent.runtime.guard import guard_for
from agent.runtime.network import NetworkSettings
from agent.runtime.pulling import Pull
from agent.runtime.snapshot import GLOBAL, plain_pose
from agent.runtime.worker import Worker
from protocol.channels import fine_register, global_register, parse_key, push_register, subscriptions
from protocol.codec import decode
from protocol.errors import LocalProtocolError, RemoteProtocolError
from protocol.features import FeatureMap
from protocol.grid import OccupancyGrid
from protocol.messages import NO_DIGEST, Beat, FineTiles, GlobalMeta, GlobalTiles, Message, Stance, Statement
from protocol.tiles import TileMap

PULL_EVERY_S = 1.5  # a page needs no more; each pull brings only what changed
LOST_AFTER_S = 15.0
FORGET_AFTER_S = 600.0
MAX_ROBOTS = 256
KEPT_STATEMENTS = 60


@dataclass(slots=True)
class Heard:
    """What one robot said last, and its map as pulled."""

    robot: str
    heard_s: float
    beat: Beat | None = None
    meta: GlobalMeta | None = None
    tiles: TileMap | None = None
    grid: OccupancyGrid | None = None


class Watcher:
    """Use with `with`; a source for the live page."""

    def __init__(self, settings: NetworkSettings) -> None:
        self._settings = settings
        self._guard = guard_for(settings, secrets.randbits(63))
        self._exchange = Exchange(settings, lambda _: None, subscriptions(settings.fleet))
        self._robots: dict[str, Heard] = {}  # who looks at what the listener writes copies it first
        self._global: tuple[GlobalMeta, TileMap, OccupancyGrid] | None = None
        self._statements: deque[Statement] = deque(maxlen=KEPT_STATEMENTS)
        self._features = DrawnFeatures(self.grid)
        self._next_pull_s = time.monotonic()
        self._workers = [
            Worker("listen", self._listen, 5.0, "messages", "what was heard"),
            Worker("pull", self._pull_step, 120.0, "what was heard", "maps"),
        ]

    def __enter__(self) -> Watcher:
        self._exchange.open()
        for worker in self._workers:
            worker.start()
        return self

    def __exit__(self, *_: object) -> None:
        for worker in self._workers:
            worker.ask_to_stop()
        self._exchange.close()
        for worker in self._workers:
            worker.join(2.0)

    # Hearing.

    def _listen(self) -> None:
        taken = self._exchange.inbox.take(0.25)
        if taken is None:
            return
        key, payload = taken
        try:
            _, robot, register = parse_key(key)
            message = decode(self._guard.open(payload, robot))
            if message.robot == robot and push_register(message) == register:
                self._hear(message)
        except (RemoteProtocolError, LocalProtocolError):
            return

    def _hear(self, message: Message) -> None:
        now_s = time.monotonic()
        if message.robot not in self._robots and len(self._robots) >= MAX_ROBOTS:
            return
        heard = self._robots.setdefault(message.robot, Heard(message.robot, now_s))
        heard.heard_s = now_s
        if isinstance(message, Beat):
            heard.beat = message
        elif isinstance(message, GlobalMeta):
            heard.meta = message
        elif isinstance(message, Statement) and all(message.evidence.id() != s.evidence.id() for s in self._statements):
            self._statements.append(message)

    # Pulling.

    def _pull_step(self) -> None:
        if self._exchange.closed.wait(0.2) or time.monotonic() < self._next_pull_s:
            return
        self._next_pull_s = time.monotonic() + PULL_EVERY_S
        for heard in list(self._robots.values()):
            if time.monotonic() - heard.heard_s > FORGET_AFTER_S:
                del self._robots[heard.robot]
            elif time.monotonic() - heard.heard_s < LOST_AFTER_S:
                self._pull_map(heard)
        self._pull_global()

    def _pull_map(self, heard: Heard) -> None:
        version = heard.beat.map if heard.beat is not None else None
        if version is None or (heard.tiles is not None and heard.tiles.digest == version.digest):
            return
        base = heard.tiles.digest if heard.tiles is not None else NO_DIGEST
        said = self._pull(heard.robot, fine_register(base, NO_DIGEST))
        if isinstance(said, FineTiles):
            try:
                heard.tiles = said.delta.apply(heard.tiles if said.delta.base_digest else None)
                heard.grid = heard.tiles.grid()
            except RemoteProtocolError:
                heard.tiles = None

    def _pull_global(self) -> None:
        """The global map of the largest group, from its composer."""
        now_s = time.monotonic()
        heard = list(self._robots.values())
        metas = [h.meta for h in heard if h.meta is not None and now_s - h.heard_s < LOST_AFTER_S]
        best = max(metas, key=lambda meta: (len(meta.members), meta.seq), default=None)
        if best is None or len(best.members) < 2:
            self._global = None
        elif self._global is None or self._global[0].digest != best.digest:
            base = self._global[1] if self._global is not None and self._global[0].robot == best.robot else None
            said = self._pull(best.robot, global_register(base.digest if base else NO_DIGEST, best.digest))
            if isinstance(said, GlobalTiles):
                try:
                    tiles = said.delta.apply(base if said.delta.base_digest else None)
                except RemoteProtocolError:
                    return
                self._global = (best, tiles, tiles.grid())

    def _pull(self, robot: str, register: str) -> Message | None:
        pull = Pull(self._exchange, self._guard, self._settings.fleet, robot, self._exchange.closed)
        return pull.run(register, is_bulk=True)

    # The page.

    def grid(self, name: str) -> tuple[str, OccupancyGrid] | None:
        """See `ViewSource`."""
        if name == GLOBAL:
            return None if self._global is None else (self._global[0].digest.hex(), self._global[2])
        heard = self._robots.get(name)
        return None if heard is None or heard.grid is None or heard.tiles is None else (heard.tiles.digest.hex(), heard.grid)

    def status(self) -> dict[str, Any]:
        """See `ViewSource`: the same shape as a robot's."""
        now_s = time.monotonic()
        robots = dict(self._robots)
        members = {member.robot: member for member in self._global[0].members} if self._global is not None else {}
        traffic = self._exchange.traffic
        grids = {name: found for name in [GLOBAL, *robots] if (found := self.grid(name)) is not None}
        focus = next((name for name in sorted(grids) if name != GLOBAL), "")  # shown while nothing is merged
        beats = {name: heard.beat for name, heard in robots.items() if heard.beat is not None}
        return {
            "robot": "watching " + self._settings.fleet,
            "group": sorted(members),
            "root": self._global[0].root if self._global is not None else "",
            "focus": focus,
            "frames": {n: plain_pose(m.T_global_map) for n, m in members.items()} or {focus: [0.0, 0.0, 0.0]},
            "poses": {n: plain_pose(b.T_map_robot) for n, b in beats.items() if b.T_map_robot is not None and not b.is_frozen},
            "maps": {name: plain_map(version, grid) for name, (version, grid) in grids.items()},
            "peers": [self._peer(heard, now_s) for _, heard in sorted(robots.items())],
            "attempts": [plain_statement(statement) for statement in list(self._statements)],
            "problems": [] if self._exchange.links() else ["no link to any robot yet: is --connect right, and is one running?"],
            "facts": {
                "robots heard": str(len(robots)),
                "links": str(len(self._exchange.links())),
                "received": f"{(traffic.received_bytes + traffic.pulled_bytes) / 1024:.0f} KB",
                "security": self._settings.security,
            },
        }

    def _peer(self, heard: Heard, now_s: float) -> dict[str, Any]:
        silent_s = now_s - heard.heard_s
        factors = [s.evidence.match_factor for s in list(self._statements) if heard.robot in (s.robot, s.other)]
        return {
            "robot": heard.robot,
            "state": "lost" if silent_s > LOST_AFTER_S else "alive",
            "age_s": round(silent_s),
            "match_factor": round(factors[-1], 4) if factors else None,
        }

    def features(self, name: str) -> FeatureMap | None:
        """See `ViewSource`."""
        return self._features.of(name)

    def metrics(self) -> str:
        """See `ViewSource`: how long each robot has been silent is all that a watcher measures."""
        lines = [
            "# HELP mapquilt_peer_silence_seconds Since a robot was last heard.",
            "# TYPE mapquilt_peer_silence_seconds gauge",
        ]
        lines += [f'mapquilt_peer_silence_seconds{{peer="{p["robot"]}"}} {p["age_s"]}' for p in self.status()["peers"]]
        return "\n".join(lines) + "\n"


def plain_map(version: str, grid: OccupancyGrid) -> dict[str, Any]:
    origin = [grid.origin.x_m, grid.origin.y_m, grid.origin.theta_rad]
    return {"version": version, "width": grid.width, "height": grid.height, "resolution_m": grid.resolution_m, "origin": origin}


def plain_statement(statement: Statement) -> dict[str, Any]:
    evidence = statement.evidence
    return {
        "peer": f"{statement.robot} + {statement.other}",
        "status": "merged" if statement.stance in (Stance.PROPOSE, Stance.ACK) else "no",
        "match_factor": round(evidence.match_factor, 4),
        "overlap_m2": round(evidence.overlap_m2, 1),
        "reason": statement.reason or statement.stance.value,
    }
