"""LIDARs on bad lines for hundreds of robot-hours: how many wrong scans are published?

    .venv/bin/python -m tests.campaigns.serial_torture --hours 100 --share 0.01 --kind bursts

A device of each protocol sees a known room; of its bytes the given share is lost or altered, half and half; the driver gets
what is left.  `bytes` are hit one by one, so that hardly a long frame survives; `bursts` hit as many in spells of twenty or so,
as a loose cable does, and leave many scans between them.  A scan is wrong when one of its beams is more than 5 cm from the room.
The standard RPLIDAR scan (0x81) has no checksum: there, wrong beams are counted against damaged bytes.  Deterministic under
--seed.  `tests/campaigns/wheel_torture.py` does the same to wheel bases.
"""

from __future__ import annotations

import json
import time
from dataclasses import asdict, dataclass

import numpy as np

from hw.driver import Driver
from tests.bench.tables import line, markdown
from tests.harness.bad_line import damaged, how, options
from tests.harness.lidar_streams import STREAMS, Stream, decode, errors_m

TILE_S = 30.0  # the period of an LDROBOT clock, so that it stays true when the tile repeats
WRONG_M = 0.05


@dataclass
class Tally:
    """What happened to one protocol."""

    protocol: str
    has_checksum: bool
    kind: str
    robot_hours: float = 0.0
    megabytes: float = 0.0
    damaged_bytes: int = 0
    frames: int = 0
    bad_frames: int = 0
    refused_frames: int = 0  # the checksum was right, the content impossible
    scans_sent: int = 0
    scans: int = 0  # handed on
    beams: int = 0
    wrong_scans: int = 0
    wrong_beams: int = 0
    worst_error_m: float = 0.0
    cpu_s: float = 0.0


def main() -> int:
    args = options(__doc__, "protocols", STREAMS).parse_args()
    if not args.json:
        print(f"{how(args.share, args.kind)}\n")
    tallies: list[Tally] = []
    for name in args.only:
        tallies.append(torture(name, args.hours, args.share, args.seed, args.kind))
        row = figures(tallies[-1])
        if not args.json:
            print(markdown([row]) if len(tallies) == 1 else line(row, list(row)), flush=True)
    if args.json:
        print(json.dumps([asdict(tally) for tally in tallies], indent=2))
    return int(any(tally.wrong_scans for tally in tallies if tally.has_checksum))


def torture(name: str, hours: float, share: float, seed: int, kind: str = "bytes") -> Tally:
    """One protocol on a bad line for so many hours."""
    stream = STREAMS[name](seconds=TILE_S)
    tally = Tally(name, stream.has_checksum, kind)
    scans_in_tile = len(decode(stream, stream.prefix + stream.data * 2)) - len(decode(stream, stream.prefix + stream.data))
    driver = stream.driver()
    driver.set_baud(round(10 * stream.bytes_per_s))
    driver.feed(stream.prefix, 0.0)
    rng = np.random.default_rng([seed, *name.encode()])
    clean = np.frombuffer(stream.data, np.uint8)
    begin_s = time.process_time()
    for tile in range(max(1, round(hours * 3600 / stream.seconds))):
        data, n_damaged = damaged(clean, kind, share, rng)
        tally.damaged_bytes += n_damaged
        tally.megabytes += len(clean) / 1e6
        tally.scans_sent += scans_in_tile
        _feed(driver, data, (tile + 1) * stream.seconds, stream, tally)
    tally.cpu_s = round(time.process_time() - begin_s, 1)
    counters = driver.counters
    tally.frames, tally.bad_frames, tally.refused_frames = counters.frames, counters.bad_frames, counters.rejected
    return tally


def _feed(driver: Driver, data: bytes, now_s: float, stream: Stream, tally: Tally) -> None:
    scans = driver.feed(data, now_s)
    tally.robot_hours += stream.seconds / 3600
    if not scans:
        return
    angles, ranges = np.concatenate([s.angles_rad for s in scans]), np.concatenate([s.ranges_m for s in scans])
    errors = np.nan_to_num(errors_m(angles, ranges), nan=0.0)
    is_wrong = errors > WRONG_M
    tally.scans += len(scans)
    tally.beams += int(np.isfinite(ranges).sum())
    tally.worst_error_m = max(tally.worst_error_m, round(float(errors.max()), 3))
    if is_wrong.any():
        owner = np.repeat(np.arange(len(scans)), [len(scan.ranges_m) for scan in scans])
        tally.wrong_scans += len(np.unique(owner[is_wrong]))
        tally.wrong_beams += int(is_wrong.sum())


def figures(t: Tally) -> dict[str, object]:
    """As people read them."""
    beams = f"{t.wrong_beams} beams, {t.wrong_beams / max(1, t.damaged_bytes):.3f} a byte"
    return {
        "protocol": t.protocol,
        "hours": f"{t.robot_hours:.1f}",
        "damaged bytes": f"{t.damaged_bytes:,}",
        "good frames": f"{t.frames:,}",
        "frames refused": f"{t.refused_frames:,}",
        "scans handed on": f"{t.scans:,} ({t.scans / max(1, t.scans_sent):.1%})",
        "wrong scans": t.wrong_scans if t.has_checksum else beams,
        "worst beam": f"{100 * t.worst_error_m:.1f} cm",
        "CPU": f"{t.cpu_s:.0f} s",
    }


if __name__ == "__main__":
    raise SystemExit(main())
