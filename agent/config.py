"""Every setting of a robot, with its default and the reason for it.

Everything works with no configuration at all.  Values come from a TOML file, from the environment
(`MAPQUILT_SECTION__KEY=value`) and from flags, the later winning; `agent/config_sources.py` reads and checks them, and
`mapquilt config show --origin` says where each one came from.  Metres, degrees where a person types an angle.

    config = load_config().config
    config.lidar.url, config.matching.min_match_factor
"""

from __future__ import annotations

import re
import socket
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, get_type_hints

Scalar = str | int | float | bool
Value = Scalar | tuple[str, ...]


class ConfigError(Exception):
    """A setting that cannot be used: says where it was written, what was seen, and what to write instead."""


def setting(default: Any, *, low: float | None = None, high: float | None = None, choices: tuple[str, ...] = ()) -> Any:
    """A field with the values it may take; `low` and `high` are themselves allowed."""
    return field(default=default, metadata={"low": low, "high": high, "choices": choices})


@dataclass(frozen=True, slots=True)
class RobotConfig:
    """Who this robot is."""

    id: str = ""  # 1 to 32 of a-z 0-9 - _, unique in the fleet; empty: made from the host name


@dataclass(frozen=True, slots=True)
class LidarConfig:
    """The laser and where it sits on the robot: the pose of its frame in the base frame (x forward, y left)."""

    url: str = ""  # rplidar:/dev/ttyUSB0, sim:office?seed=3, log:FILE.clf; empty: the first that answers on a serial port
    mount_x_m: float = setting(0.0, low=-10.0, high=10.0)
    mount_y_m: float = setting(0.0, low=-10.0, high=10.0)
    mount_yaw_deg: float = setting(0.0, low=-360.0, high=360.0)
    is_upside_down: bool = False  # mounted head over: beams run clockwise


@dataclass(frozen=True, slots=True)
class WheelsConfig:
    """The base.  A geometry of 0 is the board's own: WT1 and Create 2 tell theirs, the others need it here."""

    url: str = ""  # wheels:/dev/ttyACM0, create2:..., kobuki:..., sim:...; empty: the LIDAR's simulator or log, or who answers
    ticks_per_revolution: float = setting(0.0, low=0.0, high=1e7)
    wheel_radius_m: float = setting(0.0, low=0.0, high=2.0)
    track_m: float = setting(0.0, low=0.0, high=5.0)  # distance between the wheels
    max_speed_mps: float = setting(3.0, low=0.05, high=50.0)  # a faster wheel is a broken counter, never motion


@dataclass(frozen=True, slots=True)
class MappingConfig:
    """How the local map is drawn."""

    resolution_m: float = setting(0.05, low=0.01, high=1.0)  # halving it costs four times the memory and the messages
    particles: int = setting(30, low=1, high=1000)  # time per scan grows in proportion; 30 is what the bars are measured with
    seed: int = setting(0, low=0, high=2**63 - 1)  # the same readings and seed give the same map, to the bit
    max_range_m: float = setting(
        0.0, low=0.0, high=500.0
    )  # farther returns are ignored; 0: 25 m, beyond which beams cost time only


@dataclass(frozen=True, slots=True)
class MatchingConfig:
    """How picky matching is.  The figures are the paper's."""

    method: str = setting("hybrid", choices=("hybrid", "paper"))  # `paper` is the literal Algorithm 1, kept as the baseline
    min_match_factor: float = setting(0.85, low=0.5, high=1.0)  # lower merges sooner and wrongly sooner
    size_tolerance: float = setting(0.15, low=0.01, high=0.9)  # two features are "the same size" within this fraction


@dataclass(frozen=True, slots=True)
class FleetConfig:
    """Who the others are, and how they are met and trusted."""

    name: str = "mapquilt"  # robots of other fleets on the same network are not seen
    profile: str = setting(
        "loopback", choices=("loopback", "lan", "radio", "infrastructure")
    )  # nothing leaves the machine unasked
    listen: tuple[str, ...] = ()  # Zenoh endpoints, as tcp/0.0.0.0:7447; empty: the profile's own
    connect: tuple[str, ...] = ()  # peers or routers to dial
    security: str = setting("open", choices=("open", "shared", "mtls"))
    allow_open: bool = False  # `open` beyond loopback must be said on purpose
    key_file: str = ""  # `shared`: the fleet's secret
    certificates: str = ""  # `mtls`: the directory that `mapquilt fleet enroll` made
    priors: tuple[str, ...] = ()  # given maps (YAML), each a frozen peer


@dataclass(frozen=True, slots=True)
class ViewConfig:
    """The live page."""

    enabled: bool = True
    host: str = "127.0.0.1"  # 0.0.0.0 shows it to the whole network
    port: int = setting(8080, low=0, high=65535)  # 0: any free one; a taken port moves on to the next free one


@dataclass(frozen=True, slots=True)
class Ros2Config:
    """The maps and frames as a node of a ROS 2 graph (rmw_zenoh); no ROS is needed here."""

    enabled: bool = False  # on one robot of a ROS graph, or on a laptop: mapquilt watch --ros2
    domain: int = setting(-1, low=-1, high=232)  # -1: ROS_DOMAIN_ID, else 0
    connect: tuple[str, ...] = ("tcp/localhost:7447",)  # where ros2 run rmw_zenoh_cpp rmw_zenohd listens
    distro: str = setting("jazzy", choices=("humble", "jazzy", "kilted", "lyrical", "rolling"))  # humble's keys lack type hashes


@dataclass(frozen=True, slots=True)
class StateConfig:
    """What survives a restart, and where."""

    dir: str = ""  # empty: $STATE_DIRECTORY under systemd, else ~/.local/state/mapquilt/ID
    save_every_s: float = setting(10.0, low=0.5, high=3600.0)  # what a power cut may cost; each save writes the whole map


@dataclass(frozen=True, slots=True)
class LogConfig:
    """What is said on stderr."""

    level: str = setting("info", choices=("debug", "info", "warning", "error"))


@dataclass(frozen=True, slots=True)
class Config:
    """All of it."""

    robot: RobotConfig = RobotConfig()
    lidar: LidarConfig = LidarConfig()
    wheels: WheelsConfig = WheelsConfig()
    mapping: MappingConfig = MappingConfig()
    matching: MatchingConfig = MatchingConfig()
    fleet: FleetConfig = FleetConfig()
    view: ViewConfig = ViewConfig()
    ros2: Ros2Config = Ros2Config()
    state: StateConfig = StateConfig()
    log: LogConfig = LogConfig()

    def items(self) -> list[tuple[str, Value]]:
        """Every setting as ("section.key", value), in the order of this file."""
        return [
            (f"{section.name}.{entry.name}", getattr(getattr(self, section.name), entry.name))
            for section in fields(self)
            for entry in fields(getattr(self, section.name))
        ]


@dataclass(frozen=True, slots=True)
class Key:
    """One setting's name, type and limits."""

    name: str  # "section.key"
    kind: type  # str, int, float, bool or tuple (of strings)
    default: Value
    low: float | None
    high: float | None
    choices: tuple[str, ...]


def keys() -> dict[str, Key]:
    """Every setting by its full name."""
    return {key.name: key for name, section in sections().items() for key in _keys_of(name, section)}


def sections() -> dict[str, type[Any]]:
    """Section name -> its dataclass."""
    hints: dict[str, type[Any]] = get_type_hints(Config)
    return hints


def _keys_of(section: str, kind: type[Any]) -> Iterator[Key]:
    hints = get_type_hints(kind)
    for entry in fields(kind):
        limits = entry.metadata
        plain = hints[entry.name] if hints[entry.name] in (str, int, float, bool) else tuple
        default: Any = entry.default
        name = f"{section}.{entry.name}"
        yield Key(name, plain, default, limits.get("low"), limits.get("high"), limits.get("choices", ()))


def default_robot_id() -> str:
    """An id out of the host name: what is left when everything that cannot be in a key is taken out."""
    name = re.sub(r"[^a-z0-9_-]+", "-", socket.gethostname().partition(".")[0].lower()).strip("-_")[:32]
    return name or "robot"


def state_dir(config: Config, environ: Mapping[str, str]) -> Path:
    """Where this robot keeps its map between starts."""
    if config.state.dir:
        return Path(config.state.dir).expanduser()
    if environ.get("STATE_DIRECTORY"):  # systemd made it for this unit alone
        return Path(environ["STATE_DIRECTORY"].partition(":")[0])
    base = environ.get("XDG_STATE_HOME") or str(Path(environ.get("HOME") or "~").expanduser() / ".local/state")
    return Path(base) / "mapquilt" / config.robot.id


def control_socket(robot: str, environ: Mapping[str, str]) -> Path:
    """The 0600 socket on which the running robot takes `status`, `pause`, `save` and the like."""
    return runtime_dir(environ) / f"{robot}.sock"


def runtime_dir(environ: Mapping[str, str]) -> Path:
    """The directory of sockets, readable by its owner only."""
    if environ.get("RUNTIME_DIRECTORY"):
        return Path(environ["RUNTIME_DIRECTORY"].partition(":")[0])
    if environ.get("XDG_RUNTIME_DIR"):
        return Path(environ["XDG_RUNTIME_DIR"]) / "mapquilt"
    return Path(environ.get("HOME") or "~").expanduser() / ".local/state/mapquilt/run"
