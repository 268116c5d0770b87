"""What a simulated fleet is made of: robot processes, the links between them, and taps in their sockets."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from agent.fleet.coordinator import Coordinator
from agent.fleet.effects import Note
from agent.fleet.options import FleetOptions
from protocol.codec import encode
from protocol.messages import GlobalMap, Message
from tests.fleet.explorer import Explorer

if TYPE_CHECKING:
    from tests.fleet.simulation import Fleet


@dataclass
class Link:
    """How one direction of the network behaves."""

    loss: float = 0.0
    delay_s: tuple[float, float] = (0.005, 0.03)
    duplicates: float = 0.0


@dataclass
class Node:
    """One robot process; `robot` is the id it uses, which should be its own."""

    name: str
    robot: str
    explorer: Explorer | None
    options: FleetOptions
    coordinator: Coordinator | None = None
    tap: Tap | None = None
    life: int = 0
    clock_offset_s: float = 0.0
    global_map: GlobalMap | None = None
    notes: list[Note] = field(default_factory=list)
    sent: Counter[str] = field(default_factory=Counter)  # bytes by kind
    messages: Counter[str] = field(default_factory=Counter)
    received_messages: int = 0
    received_bytes: int = 0
    pulled_bytes: int = 0

    @property
    def is_up(self) -> bool:
        return self.coordinator is not None


class Tap:
    """Sits in a robot's network socket: a hostile robot is an honest one whose words are changed on the way out."""

    def say(self, fleet: Fleet, node: Node, message: Message, to: str) -> list[bytes]:
        """What really goes to one receiver."""
        return [encode(message)]

    def answer(self, fleet: Fleet, node: Node, key: str, data: bytes | None) -> bytes | None:
        """What really is answered to a query."""
        return data
