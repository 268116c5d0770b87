"""CPU of reading a LIDAR: port, supervisor and decoder together, in a process that does nothing else.

    .venv/bin/python -m tests.bench.lidar_cpu [--seconds 20] [--json]

Another process sends each device's bytes through a pty at the device's own pace; this one reads scans with `open_lidar` and
reports its CPU time (all threads, user and system) as a share of one core.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import multiprocessing
import os
import pty
import time
import tty
from dataclasses import asdict, dataclass
from multiprocessing.synchronize import Event

from hw.device import build_driver
from hw.port import SerialPort
from hw.supervisor import Device
from hw.urls import parse_url
from tests.bench.tables import markdown
from tests.harness.lidar_streams import STREAMS, Stream

SCHEMES = {"ld06": "ld19", "stl27l": "stl27l", "rplidar-0x81": "rplidar", "rplidar-0x82": "rplidar", "rplidar-0x85": "rplidar"}
SCHEMES |= {"rplidar-0x86": "rplidar", "ydlidar-2B": "ydlidar", "xv11": "xv11", "lds01": "lds01"}
SCHEMES |= {"hokuyo-urg": "hokuyo", "hokuyo-utm": "hokuyo", "sick": "sick"}
NAMES = {
    "ld06": "LDROBOT LD19, 4.5 kHz",
    "stl27l": "LDROBOT STL-27L, 21.6 kHz",
    "rplidar-0x81": "RPLIDAR A1 standard, 2 kHz",
    "rplidar-0x82": "RPLIDAR A2 express, 8 kHz",
    "rplidar-0x85": "RPLIDAR S1 dense, 10 kHz",
    "rplidar-0x86": "RPLIDAR S2/S3 ultra-dense, 32 kHz",
    "ydlidar-2B": "YDLIDAR G4, 5 kHz",
    "xv11": "Neato XV-11",
    "lds01": "LDS-01",
    "hokuyo-urg": "Hokuyo URG-04LX, 10 Hz",
    "hokuyo-utm": "Hokuyo UTM-30LX, 40 Hz",
    "sick": "SICK LMS291, 38400 baud",
}


START_EVERY_S = 1.5  # long enough for three turns of the slowest


@dataclass
class Row:
    """One device."""

    device: str
    kilobytes_per_s: float
    scans_per_s: float
    points_per_s: float
    cpu_percent: float
    late_ms: float  # median: last beam measured to scan handed on


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seconds", type=float, default=20.0, help="each device is read so long")
    parser.add_argument("--only", help="streams, separated by commas")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    rows = [measure(name, args.seconds) for name in (args.only.split(",") if args.only else SCHEMES)]
    if args.json:
        print(json.dumps([asdict(row) for row in rows], indent=2))
        return 0
    print(markdown([figures(row) for row in rows]))
    return 0


def figures(row: Row) -> dict[str, str]:
    """As people read them."""
    return {
        "device": row.device,
        "kB/s": f"{row.kilobytes_per_s:.1f}",
        "scans/s": f"{row.scans_per_s:.1f}",
        "points/s": f"{row.points_per_s:,.0f}",
        "CPU of one core": f"{row.cpu_percent:.2f} %",
        "scan late by": f"{row.late_ms:.0f} ms",
    }


def measure(name: str, seconds: float) -> Row:
    """Read one device for so long."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    path = os.ttyname(slave)
    stop, is_read = multiprocessing.Event(), multiprocessing.Event()
    stream = STREAMS[name](seconds=30.0 if name in ("ld06", "stl27l") else 2.0)
    sender = multiprocessing.get_context("fork").Process(target=send, args=(stream, master, stop, is_read), daemon=True)
    sender.start()
    url = parse_url(f"{SCHEMES[name]}:{path}")
    # the sender answers no questions, as most LIDARs stream whether asked or not
    device = Device(url.text, build_driver(url, "lidar"), lambda baud, dtr: SerialPort(path, baud, dtr), path, is_passive=True)
    with device:
        deadline_s = time.monotonic() + 30.0
        while device.health().readings < 10:
            if device.read(1.0) is not None:
                is_read.set()
            if time.monotonic() > deadline_s:
                raise SystemExit(f"{name}: {device.health().last_error}")
        row = _watch(name, device, seconds)
    stop.set()
    sender.join(2.0)
    for fd in (master, slave):
        with contextlib.suppress(OSError):
            os.close(fd)
    return row


def _watch(name: str, device: Device, seconds: float) -> Row:
    scans = points = 0
    late_s: list[float] = []
    cpu_s, begin_s = time.process_time(), time.monotonic()
    seen = device._driver.counters.bytes_in
    while time.monotonic() - begin_s < seconds:
        scan = device.read(1.0)
        if scan is None:
            continue
        scans += 1
        points += len(scan.ranges_m)  # type: ignore[union-attr]
        late_s.append(time.monotonic() - scan.stamp_s - scan.duration_s)  # type: ignore[union-attr]
    wall_s = time.monotonic() - begin_s
    cpu_s = time.process_time() - cpu_s
    kilobytes = (device._driver.counters.bytes_in - seen) / 1e3
    late_s.sort()
    return Row(
        NAMES[name], kilobytes / wall_s, scans / wall_s, points / wall_s, 100 * cpu_s / wall_s, 1e3 * late_s[len(late_s) // 2]
    )


def send(stream: Stream, master: int, stop: Event, is_read: Event) -> None:
    """The device: its bytes, at its pace, in millisecond portions; begun anew until the reader has made sense of them."""
    data = stream.data
    begin_s, at = time.monotonic(), 0
    next_start_s = begin_s
    while not stop.is_set():
        now_s = time.monotonic()
        if stream.prefix and now_s >= next_start_s and not is_read.is_set():  # the reader flushes what came while it opened
            os.write(master, stream.prefix)
            next_start_s, begin_s, at = now_s + START_EVERY_S, now_s, 0
        n = int((now_s - begin_s) * stream.bytes_per_s) - at
        if n > 0:
            first = at % len(data)
            at += os.write(master, (data[first : first + n] or data[:n])[:4000])
        time.sleep(0.001)


if __name__ == "__main__":
    raise SystemExit(main())
