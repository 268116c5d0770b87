"""LIDARs on bad lines for hundreds of robot-hours: how many wrong scans are published?

    .venv/bin/python -m tests.campaigns.serial_torture --hours 100 --share 0.01

A device of each protocol sees a known room; of its bytes the given share is lost or has bits flipped, half and half; the
driver gets what is left.  A scan is wrong when one of its beams is more than 5 cm from the room.  The standard RPLIDAR scan
(0x81) has no checksum: there, wrong beams are counted against damaged bytes.  One process, deterministic under --seed.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import asdict, dataclass

import numpy as np

from hw.driver import Driver
from tests.harness.lidar_streams import STREAMS, Stream, errors_m

TILE_S = 30.0  # the period of an LDROBOT clock, so that it stays true when the tile repeats
WRONG_M = 0.05


@dataclass
class Tally:
    """What happened to one protocol."""

    protocol: str
    has_checksum: bool
    robot_hours: float = 0.0
    megabytes: float = 0.0
    damaged_bytes: int = 0
    frames: int = 0
    bad_frames: int = 0
    refused_frames: int = 0  # the checksum was right, the content impossible
    scans: int = 0
    partial_scans: int = 0
    beams: int = 0
    wrong_scans: int = 0
    wrong_beams: int = 0
    worst_error_m: float = 0.0
    cpu_s: float = 0.0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--hours", type=float, default=1.0, help="of robot time for each protocol")
    parser.add_argument("--share", type=float, default=0.01, help="of bytes damaged: half lost, half with a flipped bit")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", help="protocols, separated by commas")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    names = args.only.split(",") if args.only else list(STREAMS)
    tallies = [torture(name, args.hours, args.share, args.seed) for name in names]
    print(json.dumps([asdict(tally) for tally in tallies], indent=2) if args.json else table(tallies, args.share))
    return int(any(tally.wrong_scans for tally in tallies if tally.has_checksum))


def torture(name: str, hours: float, share: float, seed: int) -> Tally:
    """One protocol on a bad line for so many hours."""
    stream = STREAMS[name](seconds=TILE_S)
    tally = Tally(name, stream.has_checksum)
    driver = stream.driver()
    driver.set_baud(round(10 * stream.bytes_per_s))
    driver.feed(stream.prefix, 0.0)
    rng = np.random.default_rng([seed, *name.encode()])
    clean = np.frombuffer(stream.data, np.uint8)
    begin_s = time.process_time()
    for tile in range(max(1, round(hours * 3600 / stream.seconds))):
        data = damaged(clean, share, rng, tally)
        _feed(driver, data, (tile + 1) * stream.seconds, stream, tally)
    tally.cpu_s = round(time.process_time() - begin_s, 1)
    counters = driver.counters
    tally.frames, tally.bad_frames, tally.refused_frames = counters.frames, counters.bad_frames, counters.rejected
    return tally


def damaged(clean: np.ndarray, share: float, rng: np.random.Generator, tally: Tally) -> bytes:
    """A copy with a share of its bytes lost or flipped: one bit in half of the flips, any byte in the other half."""
    n = len(clean)
    data = clean.copy()
    hit = np.flatnonzero(rng.random(n) < share)
    is_lost = rng.random(len(hit)) < 0.5
    flips = np.where(rng.random(len(hit)) < 0.5, 1 << rng.integers(0, 8, len(hit)), rng.integers(1, 256, len(hit)))
    data[hit] ^= np.where(is_lost, 0, flips).astype(np.uint8)
    tally.damaged_bytes += len(hit)
    tally.megabytes += n / 1e6
    return np.delete(data, hit[is_lost]).tobytes()


def _feed(driver: Driver, data: bytes, now_s: float, stream: Stream, tally: Tally) -> None:
    scans = driver.feed(data, now_s)
    tally.robot_hours += stream.seconds / 3600
    if not scans:
        return
    angles, ranges = np.concatenate([s.angles_rad for s in scans]), np.concatenate([s.ranges_m for s in scans])
    errors = np.nan_to_num(errors_m(angles, ranges), nan=0.0)
    is_wrong = errors > WRONG_M
    tally.scans += len(scans)
    tally.partial_scans += sum(scan.is_partial for scan in scans)
    tally.beams += int(np.isfinite(ranges).sum())
    tally.worst_error_m = max(tally.worst_error_m, round(float(errors.max()), 3))
    if is_wrong.any():
        owner = np.repeat(np.arange(len(scans)), [len(scan.ranges_m) for scan in scans])
        tally.wrong_scans += len(np.unique(owner[is_wrong]))
        tally.wrong_beams += int(is_wrong.sum())


def table(tallies: list[Tally], share: float) -> str:
    """Markdown."""
    lines = [
        f"{share:.3%} of the bytes lost or flipped",
        "",
        "| protocol | robot-hours | damaged bytes | good frames | frames refused | scans (partial) | wrong scans | worst beam |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for t in tallies:
        wrong = (
            str(t.wrong_scans)
            if t.has_checksum
            else f"{t.wrong_beams} beams, {t.wrong_beams / max(1, t.damaged_bytes):.2f} a damaged byte"
        )
        lines.append(
            f"| {t.protocol} | {t.robot_hours:.1f} | {t.damaged_bytes:,} | {t.frames:,} | {t.refused_frames:,} "
            f"| {t.scans:,} ({t.partial_scans:,}) | {wrong} | {100 * t.worst_error_m:.1f} cm |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    raise SystemExit(main())
