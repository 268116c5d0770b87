"""How long until a stalled or unplugged LIDAR is noticed, and how long until its scans are back.

    .venv/bin/python -m tests.campaigns.serial_timing --rounds 20

An LD06 on a real pty falls silent, or its cable is pulled and plugged in again under another pts, for 0.2 to 4 seconds; the
device under test is opened with `open_lidar` and left alone.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from hw.device import open_lidar
from hw.health import DeviceHealth, DeviceState
from hw.supervisor import Device
from tests.bench.tables import markdown
from tests.harness.serial_device import SerialDevice

BARS = {"stall noticed": 0.5, "stream back": 2.0, "unplug noticed": 0.2, "back after replug": 1.0}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    times = measure(args.rounds, random.Random(args.seed))
    rows = {
        name: {"median_s": statistics.median(values), "worst_s": max(values), "bar_s": BARS[name]}
        for name, values in times.items()
    }
    if args.json:
        print(json.dumps(rows, indent=2))
    else:
        print(f"{args.rounds} rounds\n")
        spoken = [
            {"": name} | {figure.removesuffix("_s"): f"{s:.2f} s" for figure, s in row.items()} for name, row in rows.items()
        ]
        print(markdown(spoken))
    return int(any(row["worst_s"] > row["bar_s"] for row in rows.values()))


def measure(rounds: int, rng: random.Random) -> dict[str, list[float]]:
    """So many stalls and pulled cables."""
    times: dict[str, list[float]] = {name: [] for name in BARS}
    with tempfile.TemporaryDirectory() as folder, SerialDevice("ld06", Path(folder) / "lidar") as lidar:
        device = open_lidar(lidar.url)
        assert isinstance(device, Device)
        with device:
            until(device, lambda h: h.readings >= 5)
            for _ in range(rounds):
                _stall(device, lidar, rng, times)
                _unplug(device, lidar, rng, times)
    return times


def _stall(device: Device, lidar: SerialDevice, rng: random.Random, times: dict[str, list[float]]) -> None:
    stalls = device.health().stalls
    lidar.silence()
    times["stall noticed"].append(until(device, lambda h: h.stalls > stalls))
    time.sleep(rng.uniform(0.2, 4.0))
    lidar.relieve()
    times["stream back"].append(_next_scan(device))
    until(device, lambda h: h.state is DeviceState.RUNNING)


def _unplug(device: Device, lidar: SerialDevice, rng: random.Random, times: dict[str, list[float]]) -> None:
    lidar.pull()
    times["unplug noticed"].append(until(device, lambda h: h.state is DeviceState.DISCONNECTED))
    time.sleep(rng.uniform(0.2, 4.0))
    spare = os.openpty()
    lidar.relieve()
    times["back after replug"].append(_next_scan(device))
    for fd in spare:
        os.close(fd)
    until(device, lambda h: h.state is DeviceState.RUNNING)


def _next_scan(device: Device) -> float:
    readings = device.health().readings
    return until(device, lambda h: h.readings > readings)


def until(device: Device, holds: Callable[[DeviceHealth], bool], seconds: float = 20.0) -> float:
    """Seconds until it holds."""
    begin_s = time.monotonic()
    while time.monotonic() - begin_s < seconds:
        if holds(device.health()):
            return time.monotonic() - begin_s
        time.sleep(0.005)
    raise SystemExit(f"never: {device.health()}")


if __name__ == "__main__":
    raise SystemExit(main())
