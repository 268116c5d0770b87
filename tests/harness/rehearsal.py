"""A robot's whole logic on one thread and in recorded time: its devices' bytes and its peers' words in, decisions out.

It is the `Node` that runs on a robot, with its own table of workers, on a clock that stands still while they work; Zenoh is
replaced by a `Wire` in memory, or by the `Tape` of what a robot heard on one.  The same bytes at the same stamps give the same
decisions, to the bit.

    wire = Wire()
    robots = [Rehearsal(config, drivers, wire.exchange) for ...]
    ...sense(...), turn(now_s)
"""

from __future__ import annotations

import hashlib
import threading
from collections import defaultdict, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from agent.config import Config
from agent.runtime.latest import KeyedLatest
from agent.runtime.network import NetworkSettings
from agent.runtime.node import Node
from agent.runtime.pace import Pace
from agent.runtime.traffic import Traffic
from hw.driver import Driver
from protocol.channels import parse_key

BOOT_ID = 42
UNWATCHED = ("lidar", "wheels", "keeper")  # workers that touch devices and disk


class Rehearsal:
    """One robot."""

    def __init__(self, config: Config, drivers: Mapping[str, Driver], exchange: Callable[..., Any]) -> None:
        self.now_s = 0.0
        self.maps: list[str] = []  # what was drawn, each second
        self._drivers = drivers
        self._said = hashlib.sha256()
        pace = Pace(lambda: self.now_s, is_waiting=False)
        self.node = Node(config, None, None, boot_id=BOOT_ID, pace=pace, exchange=self._listening(exchange))
        self._workers = [worker for worker in reversed(self.node.workers) if worker.name not in UNWATCHED]

    def _listening(self, exchange: Callable[..., Any]) -> Callable[..., Any]:
        def make(*words: Any) -> Any:
            made = exchange(*words)
            made.on_put = lambda key, payload: self._said.update(key.encode() + payload)
            return made

        return make

    def sense(self, device: str, now_s: float, data: bytes) -> None:
        """Bytes of a device, as they came from its port."""
        for reading in self._drivers[device].feed(data, now_s):
            self.node.readings.put(reading)

    def turn(self, now_s: float) -> None:
        """Every worker does what there is to do, until nobody has anything left."""
        self.now_s = now_s
        before = self.node.map.newest
        for _ in range(100):
            for worker in self._workers:
                worker.step()
            if not self.node.fleet.waiting() and not self.node.merger.waiting():
                break
        newest = self.node.map.newest
        if newest is not None and newest is not before:
            pose = newest.T_map_robot
            self.maps.append(f"{newest.grid.content_hash().hex()} {pose.x_m!r} {pose.y_m!r} {pose.theta_rad!r}")

    def decisions(self) -> list[dict[str, Any]]:
        """Every note of the fleet logic, merge attempts among them, without the labels of time."""
        labels = ("time", "uptime_s")
        return [{k: v for k, v in record.items() if k not in labels} for record in self.node.records.newest(1000)]

    def digest(self) -> str:
        """Of all this robot drew, decided and said: one bit of difference anywhere is a difference here."""
        global_map = self.node.fleet.global_map
        held = global_map.digest.hex() if global_map else "none"
        whole = "\n".join([*self.maps, *map(repr, self.decisions()), self._said.hexdigest(), held])
        return hashlib.sha256(whole.encode()).hexdigest()


@dataclass
class Heard:
    """What came to one robot over the network: hints with the time they came, and answers in the order they were asked for."""

    hints: list[tuple[float, str, bytes]] = field(default_factory=list)
    answers: dict[str, deque[bytes | None]] = field(default_factory=lambda: defaultdict(deque))


class Line:
    """What a `FleetWorker` needs of its `Exchange`."""

    def __init__(self, settings: NetworkSettings, ask: Callable[[str], bytes | None]) -> None:
        self.settings = settings
        self.inbox: KeyedLatest[bytes] = KeyedLatest(max_keys=1024)
        self.traffic = Traffic()
        self.closed = threading.Event()
        self.is_open = True
        self.on_put: Callable[[str, bytes], None] = lambda key, payload: None
        self._ask = ask

    def put(self, key: str, payload: bytes, priority: str = "DATA", *, is_express: bool = False) -> bool:
        """Say something."""
        self.on_put(key, payload)
        return True

    def ask(self, key: str, priority: str = "DATA") -> bytes | None:
        """Pull a register; the answer is there at once."""
        return self._ask(key)

    def receive(self, pending: bytes | None) -> bytes | None:
        """What was asked for."""
        return pending


class Wire:
    """A network in memory between rehearsed robots; `heard` keeps what each of them got from it."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.heard: dict[str, Heard] = defaultdict(Heard)
        self._lines: dict[str, WireLine] = {}

    def exchange(self, settings: NetworkSettings, answer: Callable[[str], bytes | None], *_: object) -> Line:
        """A robot's end."""
        line = self._lines[settings.robot] = WireLine(self, settings, answer)
        return line

    def say(self, speaker: str, key: str, payload: bytes) -> None:
        """To everybody else."""
        for robot, line in self._lines.items():
            if robot != speaker:
                self.heard[robot].hints.append((self.now_s, key, payload))
                line.inbox.put(key, payload)

    def ask(self, asker: str, key: str) -> bytes | None:
        """The robot that the key names."""
        line = self._lines.get(parse_key(key)[1])
        answer = line.answer(key) if line is not None else None
        self.heard[asker].answers[key].append(answer)
        return answer


class WireLine(Line):
    """A `Line` to a `Wire`."""

    def __init__(self, wire: Wire, settings: NetworkSettings, answer: Callable[[str], bytes | None]) -> None:
        super().__init__(settings, lambda key: wire.ask(settings.robot, key))
        self._wire, self.answer = wire, answer

    def put(self, key: str, payload: bytes, priority: str = "DATA", *, is_express: bool = False) -> bool:
        """See `Line.put`."""
        self._wire.say(self.settings.robot, key, payload)
        return super().put(key, payload, priority, is_express=is_express)


class Tape:
    """What a robot heard once, played to it again: the rest of the fleet is not there."""

    def __init__(self, heard: Heard) -> None:
        self._hints = deque(heard.hints)
        self._answers = {key: deque(answers) for key, answers in heard.answers.items()}
        self._line: Line | None = None

    def exchange(self, settings: NetworkSettings, *_: object) -> Line:
        """The robot's end."""
        self._line = Line(settings, self._answer)
        return self._line

    def play_until(self, now_s: float) -> None:
        """Hints that had come before this turn."""
        assert self._line is not None
        while self._hints and self._hints[0][0] < now_s:
            _, key, payload = self._hints.popleft()
            self._line.inbox.put(key, payload)

    def _answer(self, key: str) -> bytes | None:
        answers = self._answers.get(key)
        return answers.popleft() if answers else None
