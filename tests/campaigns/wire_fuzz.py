"""C1: millions of hostile inputs at every decoder of the wire.

    .venv/bin/python -m tests.campaigns.wire_fuzz [--inputs 5000000] [--processes 2] [--seed 1] [--json FILE]

A decoder returns a value or raises `RemoteProtocolError`; anything else is an escape.  What it accepts must be valid: encoding
it again and decoding that gives the same bytes, and tiles must apply or be refused.  Inputs are mutations of one example of
every message kind (most with a repaired checksum, so that they get past the envelope), bombs, and plain noise.
"""

from __future__ import annotations

import argparse
import contextlib
import multiprocessing
import random
import resource
import struct
import sys
import time
import traceback
import zlib
from collections import Counter
from pathlib import Path
from typing import Any

import msgpack

from protocol.channels import BY_NUMBER, parse_key
from protocol.codec import HEADER_BYTES, MAGIC, decode, encode
from protocol.errors import LocalProtocolError, RemoteProtocolError
from protocol.messages import FineTiles, GlobalTiles
from protocol.security import unseal
from tests.bench.tables import markdown, write_json
from tests.protocol.examples import examples

_NASTY: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 2**31, 2**32, 2**63, 2**64 - 1, -(2**63), 0.0, -0.0, 1e308, -1e308, 5e-324, float("inf"),
    float("-inf"), float("nan"), "", "a", "A" * 40, "\x00", "\x1b[2J", "../x", "r1/**", b"", b"\x00" * 16, b"\xff" * 24,
    b"\x00" * 8, [], {}, [[]] * 5, [None] * 70, {"r": "x"}, b"\xff" * 48, struct.pack("<3d", 1e300, float("nan"), -0.0),
)  # fmt: skip
_BOMBS = (
    b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff", b"\xdb\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff", b"\x91" * 5_000,
    b"\x81\xa1a" * 3_000, b"\xdc\xff\xff" + b"\x90" * 4_000, b"\xc7\x05\x07hello", b"\xd6\xff\x00\x00\x00\x01", b"\xc1",
    b"\xdc\x10\x00" * 50,
)  # fmt: skip


def enveloped(number: int, body: bytes) -> bytes:
    head = bytes((1, number))
    return MAGIC + head + zlib.crc32(body, zlib.crc32(head)).to_bytes(4, "little") + body


class Fuzzer:
    """An endless, seeded source of inputs."""

    def __init__(self, seed: int) -> None:
        self.rng = random.Random(seed)
        self.corpus = {number: encode(examples()[channel.name]) for number, channel in BY_NUMBER.items()}
        self.plain = {number: msgpack.unpackb(data[HEADER_BYTES:]) for number, data in self.corpus.items()}
        self.numbers = sorted(self.corpus)

    def next(self) -> bytes:
        rng, number = self.rng, self.rng.choice(self.numbers)
        kind = rng.random()
        if kind < 0.45:
            return self._structured(number)
        body = bytearray(self.corpus[number][HEADER_BYTES:])
        if kind < 0.80:
            self._mutate(body)
            return enveloped(rng.choice(self.numbers) if rng.random() < 0.1 else number, bytes(body))
        if kind < 0.90:
            data = bytearray(self.corpus[number])
            self._mutate(data)
            return bytes(data)
        if kind < 0.93:
            return enveloped(number, rng.choice(_BOMBS))
        if kind < 0.96:
            return enveloped(rng.randrange(256), rng.randbytes(rng.randrange(200)))
        return rng.randbytes(rng.randrange(100))

    def _structured(self, number: int) -> bytes:
        """A well-formed body in which some values are not what they should be."""
        body = self._changed(self.plain[number], self.rng.randrange(1, 4))
        try:
            return enveloped(number, bytes(msgpack.packb(body)))
        except (ValueError, OverflowError, TypeError):
            return enveloped(number, self.corpus[number][HEADER_BYTES:])

    def _changed(self, value: Any, changes: int) -> Any:
        rng = self.rng
        if changes <= 0:
            return value
        if isinstance(value, dict) and value and rng.random() < 0.95:
            key = rng.choice(list(value))
            kind = rng.random()
            if kind < 0.1:
                return {k: v for k, v in value.items() if k != key}
            if kind < 0.15:
                return value | {rng.choice("abcdefgz"): rng.choice(_NASTY)}
            return value | {key: self._changed(value[key], changes)}
        if isinstance(value, list) and value and rng.random() < 0.8:
            at = rng.randrange(len(value))
            return [*value[:at], self._changed(value[at], changes), *value[at + 1 :]]
        if isinstance(value, bytes) and value and rng.random() < 0.7:
            data = bytearray(value)
            self._mutate(data)
            return bytes(data)
        if isinstance(value, int | float) and rng.random() < 0.5:
            return value + rng.choice((-1, 1, 0.5, 2**16, -(2**33)))
        return rng.choice(_NASTY)

    def _mutate(self, data: bytearray) -> None:
        rng = self.rng
        for _ in range(rng.choice((1, 1, 1, 2, 4, 16))):
            at = rng.randrange(len(data) + 1)
            match rng.randrange(6):
                case 0 | 1 if data:
                    data[at % len(data)] ^= 1 << rng.randrange(8)
                case 2 if data:
                    data[at % len(data)] = rng.choice((0, 1, 0x7F, 0x80, 0xC0, 0xDC, 0xDD, 0xDF, 0xFF))
                case 3:
                    data[at:at] = rng.randbytes(rng.randrange(1, 9))
                case 4:
                    del data[at : at + rng.randrange(1, 20)]
                case _:
                    data[at:at] = data[at : at + rng.randrange(1, 60)]


def check(data: bytes) -> str:
    """What became of one input; raises only for an escape or an accepted message that is not valid."""
    with contextlib.suppress(RemoteProtocolError):
        unseal(bytes(32), data)
    with contextlib.suppress(RemoteProtocolError):
        parse_key(data[:200].decode("latin-1"))
    try:
        message = decode(data)
    except RemoteProtocolError as error:
        return f"refused: {type(error).__name__}"
    if isinstance(message, FineTiles | GlobalTiles):
        try:
            message.delta.apply(None)
        except RemoteProtocolError:
            return "accepted, tiles refused"
    try:
        again = encode(message)
    except LocalProtocolError as error:
        raise AssertionError(f"accepted, but no valid message: {error}") from error
    if encode(decode(again)) != again:
        raise AssertionError("accepted, but not the same when said again")
    return "accepted"


def work(job: tuple[int, int]) -> dict[str, Any]:
    """Many inputs in one process."""
    seed, inputs = job
    fuzzer, seen = Fuzzer(seed), Counter[str]()
    slowest: list[float] = []
    escapes: list[tuple[str, str]] = []
    for _ in range(2_000):
        check(fuzzer.next())
    rss_before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for _ in range(inputs):
        data = fuzzer.next()
        started_s = time.process_time()
        try:
            seen[check(data)] += 1
        except Exception:  # every kind of escape is a finding
            escapes.append((data.hex(), traceback.format_exc(limit=-2)))
        slowest.append(time.process_time() - started_s)
    slowest.sort()
    growth_mb = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - rss_before) / 1024
    p999_ms, max_ms = 1000 * slowest[int(0.999 * inputs)], 1000 * slowest[-1]
    return {
        "seen": dict(seen),
        "escapes": escapes[:20],
        "n": len(escapes),
        "growth_mb": growth_mb,
        "p999": p999_ms,
        "max": max_ms,
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, default=5_000_000)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    started_s, jobs = time.monotonic(), max(args.processes, args.inputs // 250_000)
    share = -(-args.inputs // jobs)
    with multiprocessing.get_context("spawn").Pool(args.processes) as pool:
        parts = pool.map(work, [(args.seed * 1_000 + i, share) for i in range(jobs)], chunksize=1)
    seen = sum((Counter(part["seen"]) for part in parts), Counter[str]())
    escapes = [escape for part in parts for escape in part["escapes"]]
    figures = {
        "inputs": share * jobs,
        "escapes": sum(part["n"] for part in parts),
        "outcomes": dict(seen),
        "rss_growth_mb": round(max(part["growth_mb"] for part in parts), 1),
        "p99.9_ms": round(max(part["p999"] for part in parts), 2),
        "max_ms": round(max(part["max"] for part in parts), 2),
        "wall_s": round(time.monotonic() - started_s, 1),
        "escaped": escapes[:20],
    }
    write_json(args.json, figures)
    for data, trouble in escapes[:5]:
        print(f"{data[:400]}\n{trouble}", file=sys.stderr)
    row = {
        "inputs": f"{figures['inputs']:,}",
        "escapes or accepted invalid": figures["escapes"],
        "accepted, valid": f"{seen['accepted']:,}",
        "RSS growth": f"{figures['rss_growth_mb']} MB",
        "p99.9": f"{figures['p99.9_ms']} ms",
        "slowest": f"{figures['max_ms']} ms",
    }
    print(markdown([row]))
    return 1 if figures["escapes"] else 0


if __name__ == "__main__":
    sys.exit(main())
