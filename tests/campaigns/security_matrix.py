"""C14: everybody who should not, tries everything that should not work, on real TLS sessions and on the fleet's seal.

    .venv/bin/python -m tests.campaigns.security_matrix [--json] [--verbose]

The victim is robot `a` of the fleet {a, b, d}; c was revoked.  Who: the member b, the revoked c, and strangers (the certificate
of another fleet, also with our CA's file; an expired one; none at all; no TLS).  What: put and delete on every pushed register
of others' subtrees, answer in others' names, read what is a's, look into the admin space, and for the seal every way to
send what its owner did not, or not now.  Members' own words must arrive: a wall without a door would also pass.

Bar (RELIABILITY.md): at least 60 attempts, all blocked; every control passes.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import zenoh

from agent.cli import main as mapquilt
from agent.commands.fleet import openssl
from agent.runtime.exchange import Exchange, ExchangeError
from agent.runtime.guard import SharedGuard, guard_for
from agent.runtime.network import NetworkSettings, zenoh_config
from protocol.channels import PUSHED_REGISTERS, robot_key, subscriptions
from protocol.errors import RemoteProtocolError
from tests.bench.tables import print_row

FLEET = "secure"
REGISTERS = tuple(register.replace("*", "a") for register in PUSHED_REGISTERS)
VERBS = ("put", "delete")
LINK_WITHIN_S = 10.0
HEAR_WITHIN_S = 0.5
SHARED_BOOT = 7


class Matrix:
    """Attempts and controls, and which of them went wrong."""

    def __init__(self, *, is_verbose: bool) -> None:
        self.attempts, self.blocked, self.controls, self.passed = 0, 0, 0, 0
        self.by_who: Counter[str] = Counter()
        self._is_verbose = is_verbose

    def attempt(self, who: str, what: str, *, got_through: bool) -> None:
        self.attempts += 1
        self.by_who[who] += 1
        self.blocked += not got_through
        self._say(who, what, "GOT THROUGH" if got_through else "blocked", is_bad=got_through)

    def control(self, who: str, what: str, *, works: bool) -> None:
        self.controls += 1
        self.passed += works
        self._say(who, what, "works" if works else "DOES NOT WORK", is_bad=not works)

    def _say(self, who: str, what: str, how: str, *, is_bad: bool) -> None:
        if is_bad or self._is_verbose:
            print(f"{who}: {what}: {how}", file=sys.stderr)


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--verbose", action="store_true")
    args = parser.parse_args(argv)
    matrix = Matrix(is_verbose=args.verbose)
    with tempfile.TemporaryDirectory(prefix="mq-") as folder:
        keys = Keys(Path(folder))
        members_and_revoked(matrix, keys)
        strangers(matrix, keys)
        sealed_words(matrix, keys)
    figures = {
        "attempts": matrix.attempts,
        "blocked": matrix.blocked,
        "controls": matrix.controls,
        "controls that pass": matrix.passed,
        "by whom": ", ".join(f"{who} {count}" for who, count in matrix.by_who.items()),
    }
    print_row(figures, as_json=args.json)
    is_tight = matrix.blocked == matrix.attempts >= 60
    return 0 if is_tight and matrix.passed == matrix.controls else 1


class Keys:
    """A fleet of a, b and d, the bundle of the revoked c, and strangers' bundles."""

    def __init__(self, folder: Path) -> None:
        self.ours, self.theirs = folder / "ours", folder / "theirs"
        for where in (self.ours, self.theirs):
            run("init", where, "--fleet", FLEET)
            run("enroll", where, "a", "b", "c", "d")
        self.stolen = (self.ours / "bundles" / "c").rename(folder / "stolen-c")
        run("revoke", self.ours, "c")
        self.foreign = self.theirs / "bundles" / "b"
        self.dressed = self.copied(self.foreign, folder / "dressed", "b")
        (self.dressed / "ca.pem").write_bytes((self.ours / "ca.pem").read_bytes())
        self.expired = self.copied(self.ours / "bundles" / "b", folder / "expired", "b")
        self._expire(self.expired)

    def copied(self, bundle: Path, into: Path, robot: str) -> Path:
        into.mkdir()
        for name in ("ca.pem", f"{robot}.pem", f"{robot}.key", "acl.json"):
            (into / name).write_bytes((bundle / name).read_bytes())
        return into

    def _expire(self, bundle: Path) -> None:
        request = bundle / "request.pem"
        openssl("req", "-new", "-key", bundle / "b.key", "-subj", "/CN=b", "-out", request)
        signed_by = ("-CA", self.ours / "ca.pem", "-CAkey", self.ours / "ca.key", "-set_serial", "0x99")
        openssl("x509", "-req", "-in", request, *signed_by, "-days", 0, "-out", bundle / "b.pem")
        time.sleep(1.1)  # valid until the second in which it was made

    def member(self, robot: str) -> Path:
        return self.ours / "bundles" / robot


def run(action: str, folder: Path, *words: str) -> None:
    if mapquilt(["fleet", action, str(folder), *words, "-q"]) != 0:
        raise RuntimeError(f"mapquilt fleet {action} failed")


# Certificates.


def settings(robot: str, bundle: Path, connect: tuple[str, ...] = ()) -> NetworkSettings:
    return NetworkSettings(robot, fleet=FLEET, security="mtls", certificates=bundle, connect=connect)


def session(robot: str, bundle: Path, connect: tuple[str, ...] = (), serve: str | None = None) -> Exchange:
    answer: Callable[[str], bytes] = lambda key: f"{robot} answers".encode()  # noqa: E731
    return Exchange(settings(robot, bundle, connect), answer, subscriptions(FLEET), serve or robot_key(FLEET, robot, "**"))


def holds(condition: Callable[[], object], within_s: float) -> bool:
    deadline_s = time.monotonic() + within_s
    while not condition():
        if time.monotonic() > deadline_s:
            return False
        time.sleep(0.02)
    return True


def heard(victim: Exchange, within_s: float = HEAR_WITHIN_S) -> dict[str, bytes]:
    """Everything that comes until there is silence."""
    found = {}
    while (taken := victim.inbox.take(within_s)) is not None:
        found[taken[0]] = taken[1]
    return found


def act(robot: Exchange, verb: str, key: str) -> None:
    """Straight on the session: a liar does not use our door."""
    with contextlib.suppress(zenoh.ZError):
        robot._session.put(key, b"lie") if verb == "put" else robot._session.delete(key)


def members_and_revoked(matrix: Matrix, keys: Keys) -> None:
    with session("a", keys.member("a")) as a:
        seed = tuple(a.locators())
        with session("b", keys.member("b"), seed) as b, session("d", keys.member("d"), seed) as d:
            for name, robot in (("b", b), ("d", d)):
                beat = robot_key(FLEET, name, "beat")
                works = holds(lambda robot=robot, beat=beat: robot.put(beat, b"true") and len(a.inbox), LINK_WITHIN_S)
                matrix.control(name, "own beat", works=works)
                heard(a)
            for register in REGISTERS:
                act(b, "put", robot_key(FLEET, "b", register))
                matrix.control("b", f"own {register}", works=robot_key(FLEET, "b", register) in heard(a))
            asked = b.receive(b.ask(robot_key(FLEET, "a", "map/coarse")))
            matrix.control("b", "pull from a", works=asked == b"a answers")
            lie_on_keys(matrix, "member b", b, a, ("a", "c", "d"))
        with session("b", keys.member("b"), seed, serve=robot_key(FLEET, "d", "**")) as b:
            answer_for_others(matrix, "member b", b, a, "d")
            look_into_admin_space(matrix, "member b", b)
        with session("c", keys.stolen, seed) as c:
            holds(c.links, LINK_WITHIN_S)
            lie_on_keys(matrix, "revoked c", c, a, ("c", "a", "b"))
            got = c.receive(c.ask(robot_key(FLEET, "a", "map/coarse")))
            matrix.attempt("revoked c", "pull from a", got_through=got is not None)
            answer_for_others(matrix, "revoked c", c, a, "c")
            act(a, "put", robot_key(FLEET, "a", "beat"))
            matrix.attempt("revoked c", "hear a's beat", got_through=bool(heard(c)))


def lie_on_keys(matrix: Matrix, who: str, liar: Exchange, victim: Exchange, names: tuple[str, ...]) -> None:
    heard(victim, 0.1)
    for name in names:
        for register in REGISTERS:
            for verb in VERBS:
                for _ in range(3):
                    act(liar, verb, robot_key(FLEET, name, register))
    arrived = heard(victim)
    for name in names:
        for register in REGISTERS:
            key = robot_key(FLEET, name, register)
            for verb in VERBS:  # the inbox keeps the newest of a key: either verb that came is seen
                matrix.attempt(who, f"{verb} on {register} of {name}", got_through=key in arrived)


def answer_for_others(matrix: Matrix, who: str, liar: Exchange, victim: Exchange, name: str) -> None:
    holds(liar.links, LINK_WITHIN_S)
    for register in ("map/coarse", "map/feat", "edges"):
        got = victim.receive(victim.ask(robot_key(FLEET, name, register)))
        matrix.attempt(who, f"answer {register} of {name}", got_through=got is not None)


def look_into_admin_space(matrix: Matrix, who: str, liar: Exchange) -> None:
    own = str(liar._session.zid())
    replies = [reply for reply in liar._session.get("@/**", timeout=2.0) if reply.ok is not None]
    foreign = [str(reply.ok.key_expr) for reply in replies if own not in str(reply.ok.key_expr).split("/")[1]]
    matrix.attempt(who, "read a's admin space", got_through=bool(foreign))


# Strangers.


def strangers(matrix: Matrix, keys: Keys) -> None:
    with session("a", keys.member("a")) as a:
        seed = tuple(a.locators())
        plain = tuple(locator.replace("tls/", "tcp/") for locator in seed)
        who: dict[str, Callable[[], Exchange]] = {
            "another fleet's b": lambda: session("b", keys.foreign, seed),
            "another fleet's b with our CA": lambda: session("b", keys.dressed, seed),
            "expired b": lambda: session("b", keys.expired, seed),
            "no TLS": lambda: Exchange(NetworkSettings("b", fleet=FLEET, connect=plain), lambda _: b"lie"),
        }
        for name, make in who.items():
            try:
                with make() as stranger:
                    knock(matrix, name, stranger, a)
            except ExchangeError:  # Zenoh itself does not show such a certificate
                matrix.attempt(name, "open a session", got_through=False)
        with without_certificate(keys, seed) as stranger:
            knock(matrix, "no certificate", stranger, a)
        with session("b", keys.member("b"), seed) as b:  # after all of them, the door still opens for a member
            matrix.control("b", "link after the strangers", works=holds(b.links, LINK_WITHIN_S))


@contextlib.contextmanager
def without_certificate(keys: Keys, seed: tuple[str, ...]) -> Iterator[Exchange]:
    """A session that knows our CA and shows nothing of its own."""
    with Exchange(NetworkSettings("b", fleet=FLEET), lambda _: b"lie") as bare:
        config = zenoh_config(NetworkSettings("b", fleet=FLEET, connect=seed))
        config["transport"]["link"]["tls"] = {"root_ca_certificate": str(keys.ours / "ca.pem"), "verify_name_on_connect": False}
        bare._close_session()
        bare._session = zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
        yield bare


def knock(matrix: Matrix, who: str, stranger: Exchange, victim: Exchange) -> None:
    matrix.attempt(who, "link", got_through=holds(stranger.links, 1.5))
    heard(victim, 0.05)
    for register in REGISTERS:
        act(stranger, "put", robot_key(FLEET, "b", register))
    arrived = heard(victim)
    for register in REGISTERS:
        matrix.attempt(who, f"put on {register} of b", got_through=robot_key(FLEET, "b", register) in arrived)
    got = stranger.receive(stranger.ask(robot_key(FLEET, "a", "map/coarse")))
    matrix.attempt(who, "pull from a", got_through=got is not None)


# The fleet's seal.


def sealed_words(matrix: Matrix, keys: Keys) -> None:
    def guard(robot: str, boot: int = SHARED_BOOT) -> Any:
        shared = NetworkSettings(robot, fleet=FLEET, security="shared", key_file=keys.ours / "fleet.key").checked()
        return guard_for(shared, boot)

    def believes(data: bytes, sender: str = "b") -> bool:
        try:
            listener.open(data, sender)
        except RemoteProtocolError:
            return False
        return True

    listener, b = guard("a"), guard("b")
    words = [b.seal(f"word {i}".encode()) for i in range(12)]
    for i, sealed in enumerate(words[:6]):
        matrix.control("seal of b", f"word {i}", works=believes(sealed))
    for i, sealed in enumerate(words[:6]):
        matrix.attempt("seal", f"replay of word {i}", got_through=believes(sealed))
    fresh = words[6]
    lies = {
        "no seal": b"word",
        "nothing": b"",
        "another fleet's key": SharedGuard(bytes(range(32)), "b", SHARED_BOOT).seal(b"word"),
        "half": fresh[: len(fresh) // 2],
        "one byte short": fresh[:-1],
        "one byte long": fresh + b"\0",
        **{f"bit {8 * at} flipped": fresh[:at] + bytes([fresh[at] ^ 1]) + fresh[at + 1 :] for at in range(0, len(fresh), 4)},
    }
    for what, data in lies.items():
        matrix.attempt("seal", what, got_through=believes(data))
    matrix.attempt("seal", "b's word in the name of d", got_through=believes(words[7], "d"))
    matrix.control("seal of b", "fresh word after all that", works=believes(fresh))
    newer = guard("b", SHARED_BOOT + 1)
    matrix.control("seal of b", "after a restart", works=believes(newer.seal(b"new life")))


if __name__ == "__main__":
    sys.exit(main())
