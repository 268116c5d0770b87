"""How a robot meets others: settings, and the Zenoh configuration they amount to (no Zenoh in this file).

profile         topology                                  for
loopback        peers, seeds only, no multicast           one machine: the demo, the tests
lan             peers, multicast of the fleet's own + seeds   up to about 20 robots on one network
radio           peers, seeds, two links by priority       below 2 Mbit/s: a beat never waits behind a map
infrastructure  clients of one or more routers            more than 20 robots, or base stations

Every number below was measured (ZENOH.md) or has its reason beside it.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from protocol.names import is_robot_id

PROFILES = ("loopback", "lan", "radio", "infrastructure")
SECURITY_LEVELS = ("open", "shared", "mtls")

MAX_MESSAGE_BYTES = 2 * 1024 * 1024  # a 200 MB message costs +4 MB here, +344 MB at Zenoh's default
BATCH_BYTES = 16 * 1024  # a link keeps buffers of this size: nineteen peers cost 5.3 MB, 8.2 at Zenoh's 64 KB, for the same CPU
INTERESTS_TIMEOUT_MS = 60_000  # at the default 10 s, 2 of 3 meshes of 100 peers lost declarations for good
MAX_SESSIONS = 256


class NetworkConfigError(ValueError):
    """The network settings cannot work; says which one and what to do."""


@dataclass(frozen=True, slots=True)
class NetworkSettings:
    """Who we are on the network and where to meet the others."""

    robot: str
    fleet: str = "mapquilt"
    profile: str = "loopback"
    listen: tuple[str, ...] = ()  # empty: the profile's own
    connect: tuple[str, ...] = ()  # seeds (peers) or routers (clients)
    security: str = "open"
    allow_open: bool = False  # `open` beyond loopback, said on purpose
    key_file: Path | None = None  # `shared`: the fleet's secret
    certificates: Path | None = None  # `mtls`: directory with ca.pem, <robot>.pem, <robot>.key, acl.json
    holder: str = ""  # `mtls`: whose certificate it is; empty: the robot's own
    is_router: bool = False

    def checked(self) -> NetworkSettings:
        """These settings, or the one sentence that says why they cannot work."""
        for what, name in (("robot id", self.robot), ("fleet name", self.fleet)):
            if not is_robot_id(name):  # spaces and `*` are legal in Zenoh keys, never in ours
                raise NetworkConfigError(
                    f"{what} {name!r}: use 1 to 32 of a-z, 0-9, '-' and '_', starting with a letter or digit"
                )
        if self.profile not in PROFILES:
            raise NetworkConfigError(f"network profile {self.profile!r}: choose one of {', '.join(PROFILES)}")
        if self.security not in SECURITY_LEVELS:
            raise NetworkConfigError(f"security level {self.security!r}: choose one of {', '.join(SECURITY_LEVELS)}")
        if self.profile == "infrastructure" and not self.is_router and not self.connect:
            raise NetworkConfigError(
                "profile infrastructure needs a router: give connect = ['tcp/HOST:7447'] (see mapquilt router)"
            )
        if self.security == "shared" and self.key_file is None:
            raise NetworkConfigError(
                "security shared needs the fleet's key file: name it in fleet.key_file (mapquilt fleet init makes one)"
            )
        if self.security == "mtls" and self.certificates is None:
            raise NetworkConfigError(
                "security mtls needs the robot's certificate directory: name it in fleet.certificates "
                "(mapquilt fleet init, then mapquilt fleet enroll ROBOT, makes keys/bundles/ROBOT)"
            )
        if self.security == "open" and not self.allow_open:
            for endpoint in self.endpoints():
                if not is_loopback(endpoint):
                    raise NetworkConfigError(
                        f"refusing to listen on {endpoint} without protection: anybody on that network could send maps. "
                        "Use security shared or mtls, or say allow_open (a lab network)"
                    )
        return self

    def endpoints(self) -> tuple[str, ...]:
        """Where this process listens."""
        if self.listen:
            return self.listen
        if self.profile == "infrastructure" and not self.is_router:
            return ()  # a client only dials
        protocol = "tls" if self.security == "mtls" else "tcp"
        if self.is_router:
            return (f"{protocol}/{'0.0.0.0' if self.security != 'open' or self.allow_open else '127.0.0.1'}:7447",)
        if self.profile == "loopback":
            return (f"{protocol}/127.0.0.1:0",)
        if self.profile == "radio":  # two links: with one, a 500 KB map held the health messages back by 1.0 s (111 ms with two)
            return (f"{protocol}/0.0.0.0:7447?prio=1-3", f"{protocol}/0.0.0.0:7448?prio=4-7")
        return (f"{protocol}/0.0.0.0:0",)

    @property
    def mode(self) -> str:
        if self.is_router:
            return "router"
        return "client" if self.profile == "infrastructure" else "peer"


def is_loopback(endpoint: str) -> bool:
    address = endpoint.partition("/")[2]
    return endpoint.startswith("unixsock") or address.startswith(("127.", "localhost:", "[::1]:"))


def zenoh_config(settings: NetworkSettings) -> dict[str, Any]:
    """The Zenoh configuration as plain values; unknown keys are refused by Zenoh itself."""
    radio, loopback = settings.profile == "radio", settings.profile == "loopback"
    transport: dict[str, Any] = {
        "shared_memory": {"enabled": False},  # 16 MiB of /dev/shm per sender, left behind by every kill
        "unicast": {"max_sessions": MAX_SESSIONS, "max_links": 4 if radio else 1},
        "link": {
            "tx": {"lease": 8000 if radio else 3000, "batch_size": BATCH_BYTES},  # how late a silent death is seen; beats decide
            "rx": {"max_message_size": MAX_MESSAGE_BYTES, "buffer_size": BATCH_BYTES},
        },
    }
    config: dict[str, Any] = {
        "mode": settings.mode,
        "connect": {
            "endpoints": list(settings.connect),
            "retry": {
                "period_init_ms": 100 if loopback else 500,
                "period_max_ms": 1000 if loopback else 4000 if radio else 1500,  # a healed link has to be found within 5 s
                "period_increase_factor": 1.7,
            },
        },
        "scouting": {
            "multicast": multicast(settings),
            "gossip": {"enabled": True, "autoconnect_strategy": {"peer": {"to_peer": "greater-zid"}}},
        },
        "routing": {"interests": {"timeout": INTERESTS_TIMEOUT_MS}},
        "adminspace": {"enabled": True, "permissions": {"read": True, "write": False}},  # tells our own ephemeral port
        "transport": transport,
    }
    if settings.endpoints():
        config["listen"] = {"endpoints": list(settings.endpoints())}
    if settings.security == "mtls":
        add_certificates(config, settings)
    return config


def multicast(settings: NetworkSettings) -> dict[str, Any]:
    """Every fleet scouts on a group and port of its own, so that two fleets on one network do not meet."""
    if settings.profile != "lan":
        return {"enabled": False}
    digest = hashlib.sha256(settings.fleet.encode()).digest()
    return {"enabled": True, "address": f"224.0.1.{digest[0]}:{20_000 + int.from_bytes(digest[1:3], 'big') % 20_000}"}


def add_certificates(config: dict[str, Any], settings: NetworkSettings) -> None:
    """TLS in both directions, and the access rules: who may write where is decided by the certificate's name."""
    assert settings.certificates is not None
    folder, holder = settings.certificates, settings.holder or settings.robot
    files = {"ca": folder / "ca.pem", "certificate": folder / f"{holder}.pem", "key": folder / f"{holder}.key"}
    for what, path in files.items():
        if not path.is_file():
            raise NetworkConfigError(f"{path}: the {what} file is missing; run mapquilt fleet enroll {holder}")
    config["transport"]["link"]["protocols"] = ["tls"]
    config["transport"]["link"]["tls"] = {
        "root_ca_certificate": str(files["ca"]),
        "listen_certificate": str(files["certificate"]),
        "listen_private_key": str(files["key"]),
        "connect_certificate": str(files["certificate"]),
        "connect_private_key": str(files["key"]),
        "enable_mtls": True,
        "verify_name_on_connect": False,  # certificates name robots, not hosts; the rules bind the name to a subtree
        "close_link_on_expiration": True,
    }
    acl = folder / "acl.json"
    if not acl.is_file():
        raise NetworkConfigError(f"{acl}: the access rules are missing; run mapquilt fleet enroll {holder}")
    try:
        config["access_control"] = json.loads(acl.read_text())
    except OSError as error:
        raise NetworkConfigError(f"{acl}: cannot be read ({error.strerror}); let the robot's user read it") from error
    except ValueError as error:
        raise NetworkConfigError(f"{acl}: not valid JSON ({error}); run mapquilt fleet enroll {holder} again") from error
