"""What robots say to one another: frozen values, one class per kind of message.

Every message says who wrote it (`robot`) and in which life (`boot`: a random number drawn at each start).  State, not
events: each message is the current content of a register that only its author writes, so a lost one heals with the next.
How they become bytes is `protocol/codec.py`; where they travel is `protocol/channels.py`.

    Hello, Beat                          who is there, and which versions of everything they hold
    MapAnnouncement, CoarseMap, FineTiles    one robot's map: its features, its outline at 20 cm, its cells
    Statement, Statements                what a robot holds true about a pair of maps
    GlobalMeta, GlobalTiles              the map of a whole group, and how to make it oneself
    Estate                               what a robot that is gone said and mapped, from one that holds it
    Manifest, Chunk                      a large answer, pulled in pieces
"""

from __future__ import annotations

import enum
import hashlib
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field

from protocol.features import FeatureMap
from protocol.geometry import SE2
from protocol.grid import OccupancyGrid
from protocol.tiles import TileDelta

NO_DIGEST = b""  # "nothing yet", wherever a digest is optional

Symmetric3 = tuple[float, float, float, float, float, float]  # xx, xy, xt, yy, yt, tt of a 3x3 covariance (m, m, rad)


@dataclass(frozen=True, slots=True)
class MapVersion:
    """Exactly which map: the frame it is drawn in, how often it was published since, and what it contains."""

    frame: int  # names one map frame for ever; a robot that starts a fresh map draws a new one
    revision: int  # grows with every publication in this frame
    digest: bytes  # 16 bytes over the content: equal digests are equal maps


@dataclass(frozen=True, slots=True)
class Hello:
    """Who is there; said at the start, and to whoever is new."""

    robot: str
    boot: int
    uptime_s: float
    protocol_min: int
    protocol_max: int
    software: str
    resolution_m: float
    is_frozen: bool = False  # a given map, not a robot: it never grows and never moves
    locators: tuple[str, ...] = ()  # where its session can be dialled, for peers that lost it


@dataclass(frozen=True, slots=True)
class Beat:
    """Alive, and the versions of everything: whoever holds less, pulls."""

    robot: str
    boot: int
    seq: int  # grows with every beat of this boot
    uptime_s: float
    period_s: float  # the next beat is due after this; silence is counted in these
    map: MapVersion | None  # None: no map yet
    edges_digest: bytes  # 8 bytes over all its statements
    global_digest: bytes  # `recipe_id` of the global map it holds; NO_DIGEST: none
    T_map_robot: SE2 | None = None
    is_frozen: bool = False
    load: float = 0.0  # share of its work time that is used, 0 to 1
    known_area_m2: float = 0.0  # of `map`: how much it has grown


@dataclass(frozen=True, slots=True, eq=False)
class MapAnnouncement:
    """My map has features worth knowing; said again when it has grown, not at every revision: `Beat.map` tells those."""

    robot: str
    boot: int
    map: MapVersion
    resolution_m: float
    known_area_m2: float
    fine_bytes: int  # about what pulling every cell costs
    features: FeatureMap
    is_frozen: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class CoarseMap:
    """My map at about 20 cm a cell: cheap to pull, enough to see whether the fine one is worth it."""

    robot: str
    boot: int
    map: MapVersion  # what it was made from
    grid: OccupancyGrid


@dataclass(frozen=True, slots=True, eq=False)
class FineTiles:
    """The cells of my map that differ from the map `delta.base_digest` you hold."""

    robot: str
    boot: int
    map: MapVersion  # what you hold once `delta` is applied
    delta: TileDelta


class Stance(enum.Enum):
    """What a robot holds about a pair."""

    PROPOSE = "propose"  # I found this; check it on your own map
    ACK = "ack"  # I checked it, and it holds
    REJECT = "reject"  # I checked it, and it does not
    WITHDRAW = "withdraw"  # it held once; newer maps speak against it


@dataclass(frozen=True, slots=True)
class Evidence:
    """How map b lies on map a (a is the smaller robot id), and what speaks for it."""

    robot_a: str
    robot_b: str
    map_a: MapVersion
    map_b: MapVersion
    proposer: str
    T_a_b: SE2
    covariance: Symmetric3
    agree: int  # cells, equations (1) and (2)
    disagree: int
    overlap_m2: float
    score: float

    @property
    def match_factor(self) -> float:
        """Equation (3); 0 when nothing overlaps."""
        total = self.agree + self.disagree
        return self.agree / total if total else 0.0

    def id(self) -> bytes:
        """8 bytes that name this very evidence: same maps, same transform, same figures."""
        parts = [self.robot_a, self.robot_b, self.proposer]
        digest = hashlib.sha256("\n".join(parts).encode())
        for version in (self.map_a, self.map_b):
            digest.update(struct.pack("<QQ", version.frame, version.revision) + version.digest)
        T = self.T_a_b
        digest.update(struct.pack("<3d", T.x_m + 0.0, T.y_m + 0.0, T.theta_rad + 0.0))  # -0.0 is 0.0
        digest.update(struct.pack("<6d", *self.covariance))
        digest.update(struct.pack("<QQdd", self.agree, self.disagree, self.overlap_m2 + 0.0, self.score + 0.0))
        return digest.digest()[:8]

    def other(self, robot: str) -> str:
        return self.robot_b if robot == self.robot_a else self.robot_a


@dataclass(frozen=True, slots=True)
class Statement:
    """What its author holds about the pair (author, other): an edge lives only while both sides hold the same.

    `holds` names earlier evidence the author still stands by while newer evidence is being checked, so that a live edge
    stays live through its own renewal.
    """

    robot: str
    boot: int
    seq: int  # grows with every change of any statement of this boot
    other: str
    stance: Stance
    evidence: Evidence
    holds: bytes = NO_DIGEST
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Statements:
    """All statements of one robot: the register behind `Beat.edges_digest`."""

    robot: str
    boot: int
    seq: int
    statements: tuple[Statement, ...]


@dataclass(frozen=True, slots=True)
class GlobalMember:
    """One map in the global map."""

    robot: str
    map: MapVersion
    T_global_map: SE2
    covariance: Symmetric3


def recipe_id(root: str, members: tuple[GlobalMember, ...], digest: bytes) -> bytes:
    """16 bytes that name a global map: which maps, where, and what came out."""
    hashed = hashlib.sha256(root.encode() + digest)
    for member in members:
        T = member.T_global_map
        hashed.update(member.robot.encode() + member.map.digest)
        hashed.update(struct.pack("<Q3d", member.map.frame, T.x_m + 0.0, T.y_m + 0.0, T.theta_rad + 0.0))
        hashed.update(struct.pack("<6d", *member.covariance))
    return hashed.digest()[:16]


@dataclass(frozen=True, slots=True)
class GlobalMeta:
    """The global map as a recipe: lay exactly these maps at exactly these transforms and fuse; the result has `digest`.

    Written by the composer of the group.  Whoever holds the maps makes the global map alone and compares digests.
    """

    robot: str  # the composer
    boot: int
    seq: int
    root: str  # the member whose map frame is the global frame
    resolution_m: float
    members: tuple[GlobalMember, ...]  # by robot id
    edges: tuple[bytes, ...]  # ids of the evidence the transforms were solved from, sorted
    digest: bytes  # 16 bytes over the fused cells
    conflicting_cells: int
    agreeing_cells: int

    def member(self, robot: str) -> GlobalMember | None:
        return next((member for member in self.members if member.robot == robot), None)

    def id(self) -> bytes:
        return recipe_id(self.root, self.members, self.digest)


@dataclass(frozen=True, slots=True, eq=False)
class GlobalTiles:
    """The cells of the global map that differ from the one with `delta.base_digest`."""

    robot: str
    boot: int
    delta: TileDelta


@dataclass(frozen=True, slots=True, eq=False)
class Estate:
    """What a robot that is gone has left: its last words and its cells, as the author of this holds them."""

    robot: str  # who tells
    boot: int
    gone: str
    gone_boot: int
    is_frozen: bool
    statements: tuple[Statement, ...]  # of the robot that is gone
    map: MapVersion  # what you hold once `delta` is applied to nothing
    delta: TileDelta


@dataclass(frozen=True, slots=True)
class Manifest:
    """The answer is large: pull its pieces from `blob/<digest>/<index>` and join them."""

    robot: str
    boot: int
    digest: bytes  # sha256 of the whole, 32 bytes
    size_bytes: int
    chunk_bytes: int

    @property
    def chunks(self) -> int:
        return -(-self.size_bytes // self.chunk_bytes)


@dataclass(frozen=True, slots=True)
class Chunk:
    """One piece of a large answer."""

    robot: str
    boot: int
    digest: bytes
    index: int
    data: bytes


@dataclass(frozen=True, slots=True, eq=False)
class GlobalMap:
    """The global map as a robot holds it: never sent as such, made from `GlobalMeta` and the members' maps."""

    author: str
    root: str
    digest: bytes
    members: tuple[GlobalMember, ...]
    grid: OccupancyGrid
    conflicting_cells: int = 0
    agreeing_cells: int = 0
    T_global_robot: Mapping[str, SE2] = field(default_factory=dict)  # poses, as far as known

    def id(self) -> bytes:
        return recipe_id(self.root, self.members, self.digest)


Message = (
    Hello
    | Beat
    | MapAnnouncement
    | CoarseMap
    | FineTiles
    | Statement
    | Statements
    | GlobalMeta
    | GlobalTiles
    | Estate
    | Manifest
    | Chunk
)
