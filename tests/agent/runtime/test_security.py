"""The three levels over real Zenoh: who does not belong is not heard, and nobody speaks in another's name."""

from __future__ import annotations

import contextlib
import stat
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from agent.cli import main
from agent.fleet.options import FleetOptions
from agent.map_files import save_map
from agent.merging.result import MatchOptions
from agent.runtime.exchange import Exchange
from agent.runtime.guard import SharedGuard, guard_for
from agent.runtime.merge_worker import MergeWorker
from agent.runtime.network import NetworkConfigError, NetworkSettings
from agent.runtime.priors import FrozenPeer
from protocol.channels import robot_key, subscriptions
from protocol.codec import decode
from protocol.errors import RemoteProtocolError
from protocol.grid import OccupancyGrid
from tests.agent.runtime.test_exchange import nothing
from tests.harness.waiting import until

FLEET = "secure"


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A fleet of a and b; c was revoked."""
    folder = tmp_path_factory.mktemp("keys")
    assert main(["fleet", "init", str(folder), "--fleet", FLEET, "-q"]) == 0
    assert main(["fleet", "enroll", str(folder), "a", "b", "c", "-q"]) == 0
    bundle = (folder / "bundles" / "c").rename(folder / "stolen-c")
    assert main(["fleet", "revoke", str(folder), "c", "-q"]) == 0
    assert bundle.exists()
    return folder


def mtls(keys: Path, robot: str, connect: tuple[str, ...] = ()) -> NetworkSettings:
    member, stolen = keys / "bundles" / robot, keys / f"stolen-{robot}"
    certificates = member if member.exists() else stolen
    return NetworkSettings(robot, fleet=FLEET, security="mtls", certificates=certificates, connect=connect)


def answer(key: str) -> bytes:
    return b"from " + key.encode()


def open_exchange(settings: NetworkSettings) -> Exchange:
    return Exchange(settings, answer, subscriptions(FLEET), robot_key(FLEET, settings.robot, "**"))


def test_members_hear_and_answer_one_another_under_their_own_names_only(keys: Path) -> None:
    with open_exchange(mtls(keys, "a")) as a, open_exchange(mtls(keys, "b", tuple(a.locators()))) as b:
        assert all(locator.startswith("tls/") for locator in a.locators())
        until(lambda: b.put(robot_key(FLEET, "b", "beat"), b"true") and len(a.inbox), 15.0)
        until(lambda: b.receive(b.ask(robot_key(FLEET, "a", "map/coarse"))) is not None, 15.0)
        a.inbox.take()
        for _ in range(20):
            b.put(robot_key(FLEET, "a", "beat"), b"spoofed")
            b.put(robot_key(FLEET, "c", "beat"), b"spoofed")
        until(lambda: b.put(robot_key(FLEET, "b", "hello"), b"marker") and len(a.inbox), 15.0)
        heard = set()
        while (taken := a.inbox.take(0.3)) is not None:
            heard.add(taken[0])
        assert heard <= {robot_key(FLEET, "b", "beat"), robot_key(FLEET, "b", "hello")}


def test_a_revoked_robot_is_not_heard(keys: Path) -> None:
    with open_exchange(mtls(keys, "a")) as a, open_exchange(mtls(keys, "c", tuple(a.locators()))) as c:
        until(c.links, 15.0)
        for _ in range(20):
            c.put(robot_key(FLEET, "c", "beat"), b"let me in")
        assert c.receive(c.ask(robot_key(FLEET, "a", "map/coarse"))) is None
        assert a.inbox.take(0.3) is None


def test_a_stranger_without_a_certificate_gets_no_link(keys: Path) -> None:
    with open_exchange(mtls(keys, "a")) as a:
        plain = tuple(locator.replace("tls/", "tcp/") for locator in a.locators())
        with Exchange(NetworkSettings("x", fleet=FLEET, connect=plain), nothing) as x:
            for _ in range(20):
                x.put(robot_key(FLEET, "x", "beat"), b"hello?")
            assert a.inbox.take(1.0) is None
            assert x.links() == []


def shared(keys: Path, robot: str) -> NetworkSettings:
    return NetworkSettings(robot, fleet=FLEET, security="shared", key_file=keys / "fleet.key").checked()


def test_the_fleets_secret_opens_what_its_members_say(keys: Path) -> None:
    a, b = guard_for(shared(keys, "a"), 1), guard_for(shared(keys, "b"), 2)
    assert b.open(a.seal(b"words"), "a") == b"words"


@pytest.mark.parametrize("level", ["shared", "mtls"])
def test_a_given_map_speaks_in_its_own_name_with_its_robots_keys(keys: Path, level: str, tmp_path: Path) -> None:
    settings = {"shared": shared, "mtls": mtls}[level]
    save_map(OccupancyGrid(np.zeros((20, 20), np.int8), 0.05), tmp_path / "office")
    prior = FrozenPeer(tmp_path / "office.yaml", 1, settings(keys, "b"), MergeWorker(MatchOptions()), FleetOptions())
    beat, words = robot_key(FLEET, "b-prior1", "beat"), []
    with open_exchange(settings(keys, "a")) as a, contextlib.closing(prior):
        prior.open(tuple(a.locators()))
        step = prior.workers()[0].step
        until(lambda: step() or words.append(a.inbox.take()) or any(word and word[0] == beat for word in words), 15.0)
    sealed = next(word[1] for word in words if word and word[0] == beat)
    assert decode(guard_for(settings(keys, "a"), 1).open(sealed, "b-prior1")).robot == "b-prior1"


def test_a_revoked_robot_s_secret_opens_nothing_any_more(keys: Path) -> None:
    b, stolen = guard_for(shared(keys, "b"), 2), replace(shared(keys, "a"), key_file=keys / "stolen-c" / "fleet.key")
    with pytest.raises(RemoteProtocolError):
        b.open(guard_for(stolen, 1).seal(b"words"), "a")
    assert (keys / "bundles" / "a" / "fleet.key").read_bytes() == (keys / "fleet.key").read_bytes()


def test_unsealed_foreign_replayed_and_misnamed_words_are_refused(keys: Path) -> None:
    a, b = guard_for(shared(keys, "a"), 1), guard_for(shared(keys, "b"), 2)
    foreign = SharedGuard(bytes(32), "a", 1)
    once = a.seal(b"once")
    b.open(once, "a")
    cut = a.seal(b"words")[:-1]
    refused = ((b"words", "not sealed"), (foreign.seal(b"words"), "broken"), (once, "replay"), (cut, "broken"))
    for data, said in refused:
        with pytest.raises(RemoteProtocolError, match=said):
            b.open(data, "a")
    with pytest.raises(RemoteProtocolError, match="in the name of b"):
        b.open(a.seal(b"words"), "b")


def test_keys_are_for_their_owner_only(keys: Path) -> None:
    for private in (keys / "ca.key", keys / "fleet.key", keys / "bundles" / "a" / "a.key"):
        assert stat.S_IMODE(private.stat().st_mode) == 0o600
    assert not (keys / "bundles" / "a" / "ca.key").exists()
    loose = keys / "loose.key"
    loose.write_text("a secret for everybody")
    loose.chmod(0o644)
    with pytest.raises(NetworkConfigError, match="chmod 600"):
        guard_for(replace(shared(keys, "a"), key_file=loose), 1)


MISTAKES = (
    (["enroll", "none", "a"], 4),
    (["revoke", "keys", "nobody"], 2),
    (["init", "keys"], 2),
    (["enroll", "keys", "Not A Name"], 2),
    (["enroll", "keys"], 2),
)


@pytest.mark.parametrize(("words", "code"), MISTAKES)
def test_mistakes_are_told(keys: Path, words: list[str], code: int, capsys: pytest.CaptureFixture[str]) -> None:
    where = str(keys) if words[1] == "keys" else str(keys / words[1])
    assert main(["fleet", words[0], where, *words[2:]]) == code
    assert "mapquilt: " in capsys.readouterr().err
