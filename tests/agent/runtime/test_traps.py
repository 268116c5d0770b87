"""The traps of Zenoh (ZENOH.md, section 0) that need a bad network or a second look; the others are in `test_exchange.py`."""

from __future__ import annotations

import functools
import hashlib
import itertools
import re
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from agent.fleet.options import FleetOptions
from agent.fleet.roster import Roster
from agent.fleet.state import Presence
from agent.runtime.exchange import Exchange
from agent.runtime.guard import OpenGuard
from agent.runtime.network import PROFILES, NetworkSettings, zenoh_config
from agent.runtime.pulling import Pull
from protocol.channels import CHUNK_BYTES, MAX_PUSH_BYTES, robot_key
from protocol.codec import encode
from protocol.geometry import SE2
from protocol.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from protocol.messages import Beat, Chunk, CoarseMap, Manifest, MapVersion
from tests.agent.runtime.test_exchange import nothing
from tests.harness.network import Network
from tests.harness.waiting import until
from tests.protocol.examples import BOOT, examples

ROOT = Path(__file__).resolve().parents[3]
ROOMS = ("agent", "hw", "protocol")
LABELS_ONLY = {"agent/runtime/records.py", "agent/runtime/ros_bridge.py"}  # dates for people, and stamps as ROS wants them


@pytest.fixture
def network() -> Iterator[Network]:
    with Network() as cables:
        yield cables


def test_clients_of_a_router_hear_and_ask_one_another() -> None:
    """Fact 7: peers carry nothing for peers; whoever is not linked to everybody needs a router."""
    router = NetworkSettings("base", is_router=True, listen=("tcp/127.0.0.1:0",), profile="infrastructure")
    with Exchange(router, nothing) as base:
        seed = tuple(base.locators())

        def client(robot: str) -> Exchange:
            settings = NetworkSettings(robot, profile="infrastructure", connect=seed)
            return Exchange(settings, lambda key: key.encode(), ("t/*/beat",), f"t/{robot}/**")

        with client("a") as a, client("b") as b:
            until(lambda: a.put("t/a/beat", b"x") and len(b.inbox))
            until(lambda: b.receive(b.ask("t/a/map")) == b"t/a/map")


def test_a_silent_peer_does_not_hold_up_a_healthy_pair(network: Network) -> None:
    """Facts 3 and 9: of two peers of a hub one dies without a word; the other hears every beat in time."""
    with Exchange(NetworkSettings("hub"), nothing) as hub:
        (locator,) = hub.locators()
        cable = network.cable(locator)
        settings = [NetworkSettings(name, connect=(at,)) for name, at in (("well", locator), ("dead", cable.locator))]
        with Exchange(settings[0], nothing, ("t/*/beat",)) as well, Exchange(settings[1], nothing, ("t/*/beat",)) as dead:
            until(lambda: hub.put("t/hub/beat", b"x") and len(well.inbox) and len(dead.inbox))
            network.set(cable, "hole")
            heard_s = [time.monotonic()]
            while heard_s[-1] - heard_s[0] < 2.0:
                hub.put("t/hub/beat", bytes(15_000))
                if well.inbox.take(0.05) is not None:
                    heard_s.append(time.monotonic())
                assert time.monotonic() - heard_s[-1] < 2.0
            assert max(b - a for a, b in itertools.pairwise(heard_s)) < 1.0


def test_a_seed_that_dies_and_comes_back_is_dialled_again() -> None:
    """Fact 8: configured seeds are, for ever; links learnt by gossip are not, so the keeper opens the session anew."""
    with Exchange(NetworkSettings("seed"), nothing) as seed:
        where = tuple(seed.locators())
    leaf = Exchange(NetworkSettings("leaf", connect=where), nothing, ("t/*/beat",))
    with leaf:  # starts although nobody is there
        with Exchange(NetworkSettings("seed", listen=where), nothing) as born:
            until(lambda: born.put("t/seed/beat", b"1") and len(leaf.inbox))
        until(lambda: not leaf.links())
        leaf.inbox.take()
        with Exchange(NetworkSettings("seed", listen=where), nothing) as reborn:
            until(lambda: reborn.put("t/seed/beat", b"2") and len(leaf.inbox))


def test_a_map_crosses_a_link_of_64_kbit_a_second_while_beats_go_on(network: Network) -> None:
    """Facts 4 and 5: 19 KB in pieces, two in flight; in one answer they would hold up everything behind them."""
    cells = np.random.default_rng(1).choice(np.array([UNKNOWN, FREE, OCCUPIED], np.int8), (320, 300))
    version = MapVersion(1, 1, bytes(16))
    whole = encode(CoarseMap("amber", BOOT, version, OccupancyGrid(cells, 0.2, SE2.identity())))
    assert len(whole) > MAX_PUSH_BYTES
    digest = hashlib.sha256(whole).digest()
    pieces = [whole[i : i + CHUNK_BYTES] for i in range(0, len(whole), CHUNK_BYTES)]
    shelf = {robot_key("t", "amber", "map/coarse"): encode(Manifest("amber", BOOT, digest, len(whole), CHUNK_BYTES))}
    shelf |= {
        robot_key("t", "amber", f"blob/{digest.hex()}/{i}"): encode(Chunk("amber", BOOT, digest, i, piece))
        for i, piece in enumerate(pieces)
    }
    serve = robot_key("t", "amber", "**")
    with Exchange(NetworkSettings("amber"), shelf.get, serve=serve) as amber:
        cable = network.cable(amber.locators()[0])
        network.set(cable, "slow")
        with Exchange(NetworkSettings("birch", connect=(cable.locator,)), nothing, ("t/*/beat",)) as birch:
            until(lambda: amber.put("t/amber/beat", b"x") and len(birch.inbox), 15.0)
            pull = Pull(birch, OpenGuard(), "t", "amber", birch.closed)
            before = birch.traffic.received_messages
            said = pull.run("map/coarse", is_bulk=True)
            assert isinstance(said, CoarseMap) and np.array_equal(said.grid.cells, cells)
            until(lambda: amber.put("t/amber/beat", b"x") and birch.traffic.received_messages > before, 15.0)


def test_a_stall_of_ten_seconds_loses_nobody() -> None:
    """Fact 9: healthy links stall that long; only beats decide, and they decide later."""
    roster, beat = Roster(FleetOptions()), examples()["beat"]
    peer = roster.hear(beat, 0.0)
    assert peer is not None and isinstance(beat, Beat)
    roster.accept_beat(peer, beat, 0.0)
    roster.update_presence(10.0)
    assert peer.presence is Presence.SUSPECT
    roster.update_presence(15.1)
    assert peer.presence is Presence.LOST


@pytest.mark.parametrize("profile", PROFILES)
def test_every_profile_is_configured_against_the_traps(profile: str) -> None:
    """Facts 10, 11, 15, 16: declarations get a minute, nobody stamps, no UDP, no shared memory; nothing larger than 2 MB."""
    settings = NetworkSettings("a", profile=profile, connect=("tcp/127.0.0.1:1",), allow_open=True)
    config = zenoh_config(settings)
    assert config["routing"]["interests"]["timeout"] == 60_000
    assert "timestamping" not in config
    assert not config["transport"]["shared_memory"]["enabled"]
    assert config["transport"]["link"]["rx"]["max_message_size"] <= 2 * 1024 * 1024
    assert all(endpoint.startswith(("tcp/", "tls/")) for endpoint in settings.endpoints())
    assert not config["adminspace"]["permissions"]["write"]


@functools.cache
def uses() -> dict[str, set[str]]:
    """Which files of the program use what, written as `module.name`."""
    found: dict[str, set[str]] = defaultdict(set)
    for path in itertools.chain.from_iterable((ROOT / room).rglob("*.py") for room in ROOMS):
        for owner, name in re.findall(r"\b(\w+)\.(\w+)", path.read_text()):
            found[f"{owner}.{name}"].add(path.relative_to(ROOT).as_posix())
    return found


def users(*names: str) -> set[str]:
    return {file for name in names for file in uses().get(name, ())}


def test_nobody_forks() -> None:
    """Fact 14: a child that was forked after a session was opened hangs."""
    assert users("os.fork", "os.forkpty", "pty.fork", "multiprocessing.Process", "multiprocessing.Pool") == set()


def test_no_decision_looks_at_the_wall_clock_or_at_a_stamp_of_the_network() -> None:
    """Fact 11, and clocks that jump: time is monotonic everywhere; the wall clock only labels what people read."""
    wall = ("time.time", "time.time_ns", "time.strftime", "time.localtime", "time.gmtime", "datetime.now", "datetime.utcnow")
    assert users(*wall, "sample.timestamp", "reply.timestamp") <= LABELS_ONLY
    assert "agent/runtime/keeper.py" in users("time.monotonic")  # this search finds what is there
