"""`mapquilt scan DEVICE`: live figures of a LIDAR, and a picture of what it sees; of a wheel base, where it says it is."""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

from agent.arguments import number, whole
from agent.commands.files import writable, written_file
from agent.commands.scan_picture import scan_picture
from agent.commands.scan_wheels import WheelTeller
from agent.exits import NEGATIVE, OK, USAGE, CommandError
from agent.view.render import png
from hw.device import Source, open_lidar, open_wheels, schemes
from hw.driver import Reading
from hw.errors import DeviceConfigError
from hw.health import DeviceHealth
from hw.readings import LaserScan, Odometry
from hw.recorder import read_recording
from hw.urls import parse_url

EXAMPLES = """\
  mapquilt scan ld06:/dev/ttyUSB0                    a line a second, until Ctrl-C
  mapquilt scan rplidar:/dev/ttyUSB0 -n 20 --json    twenty scans, as JSON lines
  mapquilt scan sim:office -n 1 --png scan.png       what it sees, as a picture
  mapquilt scan wheels:/dev/ttyACM0                  push the robot a metre: do its wheels say so?
"""

BARS = " ▁▂▃▄▅▆▇█"
BINS = 24  # of the range histogram


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("device", metavar="DEVICE", help="for example ld06:/dev/ttyUSB0, or a wheel base")
    parser.add_argument("-n", "--count", type=whole(0), default=0, help="stop after so many scans (0: Ctrl-C)")
    parser.add_argument("--seconds", type=number(0), default=0.0, help="stop after so long (0: Ctrl-C)")
    parser.add_argument("--png", type=Path, metavar="FILE", help="write the last scan as a picture")
    parser.add_argument("--json", action="store_true", help="one JSON object a scan")


def run(args: argparse.Namespace) -> int:
    try:
        is_wheels = _is_base(args.device)
        device = (open_wheels if is_wheels else open_lidar)(args.device)
    except DeviceConfigError as error:
        raise CommandError(str(error), USAGE) from error
    if is_wheels and args.png:
        raise CommandError(f"--png: {args.device} sees nothing; it is a wheel base", USAGE)
    if args.png:
        writable(args.png)
    device.start()
    try:
        last, count = _watch(device, args)
    finally:
        device.stop()
    if last is None:
        raise CommandError(device.health().last_error or _silence(args), NEGATIVE)
    if args.png and isinstance(last, LaserScan):
        written_file(args.png, png(scan_picture(last)))
        print(f"{args.png}: {len(last.ranges_m)} beams", file=sys.stderr)
    print(f"{count} {'readings' if is_wheels else 'scans'}", file=sys.stderr)
    return OK


def _is_base(device: str) -> bool:
    """A recording is of what its bytes came from."""
    url = parse_url(device)
    if url.scheme == "replay":
        url = parse_url(read_recording(Path(url.path)).url)
    return url.scheme in schemes("wheels")


def _silence(args: argparse.Namespace) -> str:
    waited = f" in {args.seconds:g} s (some take 20 s to find the rate and start the motor)" if args.seconds else ""
    port = parse_url(args.device).path
    return f"{args.device}: no reading came{waited}; who answers there: mapquilt devices --probe {port}"


def _watch(device: Source, args: argparse.Namespace) -> tuple[Reading | None, int]:
    """Read and tell, until enough; the last reading and how many there were."""
    last: Reading | None = None
    count, told_s, told_error = 0, 0.0, ""
    wheels = WheelTeller(args.json)
    end_s = time.monotonic() + (args.seconds or float("inf"))
    try:
        while time.monotonic() < end_s and (count < args.count or not args.count):
            reading = device.read(0.5)
            health = device.health()
            if reading is not None:
                last, count = reading, count + 1
            if isinstance(reading, Odometry):
                wheels.tell(reading, device)
            elif reading is not None:
                if args.json:
                    print(json.dumps(figures(reading, health)), flush=True)
                elif time.monotonic() - told_s >= 1.0:
                    told_s = time.monotonic()
                    print(line(reading, health), flush=True)
            elif health.last_error != told_error:
                told_error = health.last_error
                print(told_error, file=sys.stderr)
            if reading is None and "at its end" in health.last_error:
                break
    except KeyboardInterrupt:
        pass
    return last, count


def figures(scan: LaserScan, health: DeviceHealth) -> dict[str, object]:
    """What there is to say about a scan."""
    seen = scan.ranges_m[np.isfinite(scan.ranges_m)]
    edges = np.linspace(0.0, scan.range_max_m, BINS + 1)
    return {
        "stamp_s": round(scan.stamp_s, 4),
        "state": health.state.value,
        "rate_hz": round(health.rate_hz, 2),
        "points": len(scan.ranges_m),
        "valid": len(seen),
        "coverage": round(health.coverage, 4),
        "is_partial": scan.is_partial,
        "nearest_m": round(float(seen.min()), 3) if len(seen) else None,
        "median_m": round(float(np.median(seen)), 3) if len(seen) else None,
        "farthest_m": round(float(seen.max()), 3) if len(seen) else None,
        "histogram": np.histogram(seen, edges)[0].tolist(),
        "bytes_per_s": round(health.bytes_per_s),
        "bad_frames": health.bad_frames,
        "stalls": health.stalls,
    }


def line(scan: LaserScan, health: DeviceHealth) -> str:
    """The same, as one line for a person."""
    facts = figures(scan, health)
    counts = np.histogram(scan.ranges_m[np.isfinite(scan.ranges_m)], np.linspace(0.0, scan.range_max_m, BINS + 1))[0]
    share = counts / max(1, counts.max())
    bars = "".join(BARS[min(len(BARS) - 1, int(np.ceil(s * (len(BARS) - 1))))] for s in share)
    rate = f"{health.rate_hz:5.1f}" if health.rate_hz else "    -"  # of a single scan there is none
    return (
        f"{health.model:<15} {health.state.value:<8} {rate} Hz {facts['points']:5d} points "
        f"{facts['coverage']:4.0%} of the circle  nearest {facts['nearest_m']} m  0 {bars} {scan.range_max_m:g} m"
        + (f"  {health.bad_frames} bad frames" if health.bad_frames else "")
    )
