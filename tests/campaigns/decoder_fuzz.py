"""Every device decoder fed with hostile bytes: none may raise, hang or grow.

    .venv/bin/python -m tests.campaigns.decoder_fuzz --inputs 5000000

An input is random bytes, a piece of the decoder's own stream with bytes changed, doubled, lost and moved, or pieces of
another device's stream.  A decoder must return, hand on only sane scans, and hold a bounded number of bytes; every 512
inputs it must still decode its own clean stream.
"""

from __future__ import annotations

import argparse
import json
import random
import time
from dataclasses import asdict, dataclass

import numpy as np

from hw import ld06, rplidar_nodes, rplidar_wire, scip, sick_wire, wheels, xv11, ydlidar_wire
from hw.driver import Driver
from hw.readings import LaserScan
from tests.bench.tables import markdown
from tests.harness.lidar_streams import STREAMS, Stream

INPUTS_PER_DRIVER = 512  # before it must prove itself and is made anew
MOST_HELD_BYTES = 70_000
PLAIN = (  # total functions from one frame's bytes to a value or None
    ld06.decode,
    rplidar_nodes.Node.decode,
    rplidar_wire.Descriptor.decode,
    rplidar_wire.Info.decode,
    rplidar_wire.Health.decode,
    rplidar_wire.Conf.decode,
    rplidar_wire.parse_request,
    xv11.decode_xv11,
    xv11.decode_lds01,
    ydlidar_wire.decode,
    sick_wire.decode,
    sick_wire.ScanPayload.decode,
    scip.decode_message,
    wheels.decode,
)


@dataclass
class Result:
    """What was tried and what went wrong."""

    inputs: int = 0
    megabytes: float = 0.0
    scans: int = 0
    exceptions: int = 0
    insane_scans: int = 0
    unbounded: int = 0
    deaf: int = 0  # did not decode its own stream afterwards
    first_failure: str = ""
    cpu_s: float = 0.0

    @property
    def failures(self) -> int:
        return self.exceptions + self.insane_scans + self.unbounded + self.deaf


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--inputs", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    result = fuzz(args.inputs, args.seed)
    if args.json:
        print(json.dumps(asdict(result), indent=2))
    else:
        row = {
            "inputs": f"{result.inputs:,}",
            "MB": f"{result.megabytes:.0f}",
            "scans made of them": f"{result.scans:,}",
            "exceptions": result.exceptions,
            "insane scans": result.insane_scans,
            "unbounded": result.unbounded,
            "deaf afterwards": result.deaf,
            "CPU s": result.cpu_s,
        }
        print(markdown([row]))
        print(result.first_failure)
    return int(result.failures > 0)


def fuzz(inputs: int, seed: int) -> Result:
    """So many inputs, spread over all decoders."""
    rng = random.Random(seed)
    streams = [make(seconds=1.0) for make in STREAMS.values()]
    wheel_frames = [wheels.encode(wheels.EncoderFrame(k % 256, 20_000 * k, 10 * k, -10 * k)) for k in range(64)]
    corpus = [stream.prefix + stream.data for stream in streams] + [b"".join(wheel_frames)]
    result = Result()
    begin_s = time.process_time()
    while result.inputs < inputs:
        for stream in streams:
            _fuzz_driver(stream, corpus, rng, result, min(INPUTS_PER_DRIVER, inputs - result.inputs))
        _fuzz_plain(corpus, rng, result, min(INPUTS_PER_DRIVER, inputs - result.inputs))
    result.cpu_s = round(time.process_time() - begin_s, 1)
    return result


def hostile(corpus: list[bytes], rng: random.Random, own: int | None = None) -> bytes:
    """One input, 1 to 400 bytes or so."""
    n = rng.choice((1, 5, 22, 47, 84, 132, 170, 400))
    if rng.random() < 0.15:
        return rng.randbytes(n)
    source = corpus[own if own is not None and rng.random() < 0.8 else rng.randrange(len(corpus))]
    at = rng.randrange(max(1, len(source) - n))
    data = bytearray(source[at : at + n])
    for _ in range(rng.choice((0, 1, 1, 2, 8))):
        place, kind = rng.randrange(len(data) + 1), rng.random()
        if kind < 0.4 and place < len(data):
            data[place] = rng.choice(
                (0x00, 0xFF, 0x7F, 0x80, 0xA5, 0x5A, 0xAA, 0x55, 0x54, 0x2C, 0xFA, 0x02, 0x0A, rng.randrange(256))
            )
        elif kind < 0.6:
            del data[place : place + rng.choice((1, 1, 4))]
        elif kind < 0.8:
            data[place:place] = data[: rng.randrange(1, 9)]
        else:
            data[place:place] = rng.randbytes(rng.randrange(1, 5))
        if not data:
            data = bytearray(b"\0")
    return bytes(data)


def _fuzz_driver(stream: Stream, corpus: list[bytes], rng: random.Random, result: Result, inputs: int) -> None:
    driver = stream.driver()
    own = next(i for i, data in enumerate(corpus) if data.endswith(stream.data))
    now_s = 1000.0
    if rng.random() < 0.7:
        driver.feed(stream.prefix, now_s)
    for _ in range(inputs):
        data = hostile(corpus, rng, own)
        now_s += rng.choice((0.0, 0.001, 0.01, 0.3, -0.5))
        result.inputs += 1
        result.megabytes += len(data) / 1e6
        try:
            for scan in driver.feed(data, now_s):
                result.scans += 1
                if not (isinstance(scan, LaserScan) and is_sane(scan)):
                    _failed(result, "insane_scans", stream, data)
        except Exception as error:  # the very thing looked for
            _failed(result, "exceptions", stream, data, error)
            driver = stream.driver()
    _prove(driver, stream, now_s, result)


def _prove(driver: Driver, stream: Stream, now_s: float, result: Result) -> None:
    """It holds little, and still understands its own device."""
    if len(driver._window) > MOST_HELD_BYTES:  # type: ignore[attr-defined]
        _failed(result, "unbounded", stream, b"")
    clean = stream.prefix + stream.data * 2
    try:
        scans = [
            s for k in range(0, len(clean), 2000) for s in driver.feed(clean[k : k + 2000], now_s + 1 + k / stream.bytes_per_s)
        ]
    except Exception as error:
        _failed(result, "exceptions", stream, b"clean stream afterwards", error)
        return
    if not scans:
        _failed(result, "deaf", stream, repr(driver.counters).encode())


def _fuzz_plain(corpus: list[bytes], rng: random.Random, result: Result, inputs: int) -> None:
    for _ in range(inputs):
        data = hostile(corpus, rng)
        result.inputs += 1
        result.megabytes += len(data) / 1e6
        for decode in PLAIN:
            try:
                decode(data)
            except Exception as error:
                _failed(result, "exceptions", None, data, error)


def is_sane(scan: LaserScan) -> bool:
    """Finite numbers of the right shapes, angles on the circle, times in order."""
    n = len(scan.ranges_m)
    finite = scan.ranges_m[np.isfinite(scan.ranges_m)]
    return bool(
        scan.angles_rad.shape == (n,)
        and np.isfinite(scan.angles_rad).all()
        and (np.abs(scan.angles_rad) <= 2 * np.pi).all()
        and (finite >= 0).all()
        and (finite <= scan.range_max_m + 1e-3).all()
        and np.isfinite(scan.stamp_s)
        and 0 <= scan.duration_s < 100
        and scan.time_offsets_s is not None
        and (np.diff(scan.time_offsets_s) >= 0).all()
    )


def _failed(result: Result, what: str, stream: Stream | None, data: bytes, error: Exception | None = None) -> None:
    setattr(result, what, getattr(result, what) + 1)
    result.first_failure = result.first_failure or f"{what} {stream.name if stream else 'frame'} {data.hex()} {error!r}"


if __name__ == "__main__":
    raise SystemExit(main())
