"""One table: every kind of message, the key it travels on, how urgent it is, and how large it may be.

    mapquilt/@v1/<fleet>/r/<robot>/<register>    everything a robot says; it writes only below its own <robot>

The major version is a chunk of the key, and `**` never matches a chunk that starts with `@`: two versions never meet.
"""

from __future__ import annotations

import enum
import re
from dataclasses import dataclass

from protocol import messages as m
from protocol.errors import LocalProtocolError, RemoteProtocolError
from protocol.names import is_robot_id

MAJOR_VERSION = 1
MAX_PUSH_BYTES = 16_384  # one batch of the network: larger puts are lost whole on slow links
CHUNK_BYTES = 16_000  # of a large answer; with its envelope still one batch
MAX_ANSWER_BYTES = 8_388_608  # of a large answer, joined
MAX_LIST_BYTES = 524_288  # of a thousand statements, or the recipe of a thousand members


class Urgency(enum.Enum):
    """Zenoh's priorities, by name."""

    INTERACTIVE_HIGH = "INTERACTIVE_HIGH"
    DATA_HIGH = "DATA_HIGH"
    DATA = "DATA"
    DATA_LOW = "DATA_LOW"
    BACKGROUND = "BACKGROUND"


@dataclass(frozen=True, slots=True)
class Channel:
    """Where one kind of message travels.  Everything is sent with congestion control DROP."""

    number: int  # in the envelope
    kind: type
    name: str
    register: str  # the key below the robot's subtree; {braces} are filled in
    is_pushed: bool  # published as a hint; otherwise only answered to queries
    urgency: Urgency
    max_bytes: int  # encoded, as one message
    max_items: int = 64  # lists and maps inside, and things in any one of them: what unpacking may allocate
    is_express: bool = False  # not batched with others


CHANNELS: tuple[Channel, ...] = (
    Channel(1, m.Hello, "hello", "hello", True, Urgency.DATA_HIGH, 2_048),
    Channel(2, m.Beat, "beat", "beat", True, Urgency.INTERACTIVE_HIGH, 512, is_express=True),
    Channel(3, m.MapAnnouncement, "feat", "map/feat", True, Urgency.DATA, MAX_PUSH_BYTES),
    Channel(4, m.CoarseMap, "coarse", "map/coarse", False, Urgency.DATA_LOW, MAX_ANSWER_BYTES),
    Channel(5, m.FineTiles, "fine", "map/fine/{base}/{target}", False, Urgency.BACKGROUND, MAX_ANSWER_BYTES),
    Channel(6, m.Statement, "edge", "edge/{other}", True, Urgency.DATA_HIGH, 1_024),
    Channel(7, m.Statements, "edges", "edges", False, Urgency.DATA_HIGH, MAX_LIST_BYTES, 8_192),
    Channel(8, m.GlobalMeta, "global", "global/meta", True, Urgency.DATA, MAX_LIST_BYTES, 8_192),
    Channel(9, m.GlobalTiles, "globaltiles", "global/tiles/{base}/{target}", False, Urgency.BACKGROUND, MAX_ANSWER_BYTES),
    Channel(10, m.Manifest, "manifest", "", False, Urgency.DATA, 256),
    Channel(11, m.Chunk, "chunk", "blob/{digest}/{index}", False, Urgency.BACKGROUND, MAX_PUSH_BYTES),
    Channel(12, m.Estate, "estate", "estate/{gone}/{digest}", False, Urgency.BACKGROUND, MAX_ANSWER_BYTES, 8_192),
)
BY_KIND = {channel.kind: channel for channel in CHANNELS}
BY_NUMBER = {channel.number: channel for channel in CHANNELS}
MAX_MESSAGE_BYTES = MAX_ANSWER_BYTES

PUSHED_REGISTERS = ("hello", "beat", "map/feat", "edge/*", "global/meta")
"""What everybody subscribes to, each below `<fleet>/r/*`."""

_KEY = re.compile(r"mapquilt/@v(\d{1,5})/([^/]{1,64})/r/([^/]{1,64})/(.{1,200})", re.DOTALL)


def fleet_key(fleet: str, suffix: str = "**") -> str:
    """A key expression over every robot of a fleet: `fleet_key("lab", "r/*/beat")`."""
    return f"mapquilt/@v{MAJOR_VERSION}/{_name(fleet)}/{suffix}"


def robot_key(fleet: str, robot: str, register: str) -> str:
    """The full key of one register of one robot."""
    return fleet_key(fleet, f"r/{_name(robot)}/{register}")


def subscriptions(fleet: str) -> tuple[str, ...]:
    """The key expressions of everything that is pushed."""
    return tuple(fleet_key(fleet, f"r/*/{register}") for register in PUSHED_REGISTERS)


def push_register(message: m.Message) -> str:
    """The register, below the author's subtree, on which a pushed message travels."""
    channel = BY_KIND[type(message)]
    if not channel.is_pushed:
        raise LocalProtocolError(f"a message of kind '{channel.name}' is pulled, never pushed")
    return channel.register.format(other=message.other) if isinstance(message, m.Statement) else channel.register


def parse_key(key: str) -> tuple[str, str, str]:
    """(fleet, robot, register) of a key a peer wrote on."""
    match = _KEY.fullmatch(key)
    if match is None or int(match[1]) != MAJOR_VERSION or not is_robot_id(match[2]) or not is_robot_id(match[3]):
        raise RemoteProtocolError(f"key '{key[:120]}' is not mapquilt/@v{MAJOR_VERSION}/<fleet>/r/<robot>/...")
    return match[2], match[3], match[4]


def fine_register(base: bytes, target: bytes) -> str:
    """Pull a robot's cells: the difference from `base` (empty: from nothing) to `target` (empty: to the newest)."""
    return f"map/fine/{_hex(base)}/{_hex(target)}"


def global_register(base: bytes, target: bytes) -> str:
    return f"global/tiles/{_hex(base)}/{_hex(target)}"


def estate_register(gone: str, digest: bytes) -> str:
    """Pull what a robot holds of one that is gone: of its map the version with this digest."""
    return f"estate/{gone}/{_hex(digest)}"


def chunk_register(digest: bytes, index: int) -> str:
    return f"blob/{_hex(digest)}/{index}"


def _hex(digest: bytes) -> str:
    return digest.hex() if digest else "-"


def _name(text: str) -> str:
    if not is_robot_id(text):
        raise LocalProtocolError(f"'{text[:80]}' is no name for a robot or fleet; use 1 to 32 of a-z 0-9 _ - (first a-z 0-9)")
    return text
