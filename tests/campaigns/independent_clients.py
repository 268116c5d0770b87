"""Other people's software connects to `mapquilt sim` and measures the room, or the wheels: are our bytes right?

    python3 -m venv /tmp/clients && /tmp/clients/bin/pip install rplidar-roboticia pyrplidar pyrplidarsdk rplidarc1 \\
        adafruit-circuitpython-rplidar lds2d PyLidar3 hokuyolx pycreate2 yarc create-serial basicmicro kobukidriver
    apt-get install mrpt-apps                                            # rawlog-grabber, for Hokuyo and SICK
    .venv/bin/python -m tests.campaigns.independent_clients --python /tmp/clients/bin/python

LIDARs: each client decodes the devices it knows in a known room; the median difference from the walls must be below a
centimetre, and the same device, mirrored, must not fit.  Bases: the robot explores, or drives as the client tells it; the way of
each wheel that a client reads must follow the way it went, to a centimetre, and not that of the other wheel.  A client that is
not installed is left out.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from hw.sim.catalogue import BASES
from tests.bench.tables import line, markdown
from tests.harness.client_truth import DRIVE, ROBOT_SEED, Rows, driven_errors_m, wall_errors_m, way_errors_m
from tests.harness.serial_device import POSE, ROOM
from tests.harness.waiting import until

WANTED_M = 0.01
SECONDS = 25.0
FOREIGN = Path(__file__).parents[1] / "harness" / "foreign_clients.py"
# Not here: lds2d reads an LDS-01 one degree off the maker's own ROS driver, which we follow; adafruit's express scan sends a
# request without its operands, which no RPLIDAR understands; pyrplidar reads dense capsules with their bytes swapped;
# hokuyolx counts the angles of a URG from step 0.
CASES = [  # (client, device, what the client is told, baud it is told)
    ("rplidar-roboticia", "rplidar-a1", "normal", 115200),
    ("rplidar-roboticia", "rplidar-a1", "express", 115200),
    ("adafruit-rplidar", "rplidar-a1", "normal", 115200),
    ("pyrplidar", "rplidar-a1", "standard", 115200),
    ("pyrplidar", "rplidar-a1", "1", 115200),
    ("pyrplidar", "rplidar-a1", "2", 115200),
    ("pyrplidar", "rplidar-c1", "standard", 460800),
    ("pyrplidar", "rplidar-s2", "standard", 1000000),
    ("rplidarc1", "rplidar-c1", "-", 460800),
    ("pyrplidarsdk", "rplidar-a1", "-", 115200),
    ("pyrplidarsdk", "rplidar-c1", "-", 460800),
    ("pyrplidarsdk", "rplidar-s2", "-", 1000000),
    ("pyrplidarsdk", "rplidar-a3", "-", 256000),
    ("pyrplidarsdk", "rplidar-s1", "-", 256000),
    ("pyrplidarsdk", "rplidar-s3", "-", 1000000),
    ("pyrplidar", "rplidar-a3", "3", 256000),
    ("lds2d", "rplidar-a1", "RPLIDAR-A1", 0),
    ("lds2d", "rplidar-c1", "RPLIDAR-C1", 0),
    ("lds2d", "ld06", "LD06", 0),
    ("lds2d", "ld19", "LD19", 0),
    ("lds2d", "ydlidar-x2", "YDLIDAR-X2", 0),
    ("lds2d", "ydlidar-x4", "YDLIDAR-X4", 0),
    ("pylidar3", "ydlidar-x4", "YdLidarX4", 0),
    ("lds2d", "xv11", "XV11", 0),
    ("hokuyolx", "hokuyo-utm", "GD", 0),
    ("hokuyolx", "hokuyo-utm", "GE", 0),
    ("hokuyolx", "hokuyo-utm", "MD", 0),
    ("hokuyolx", "hokuyo-utm", "ME", 0),
    ("rawlog-grabber", "hokuyo-urg", "CHokuyoURG", 0),
    ("rawlog-grabber", "hokuyo-utm", "CHokuyoURG", 0),
    ("rawlog-grabber", "sick-lms291", "CSickLaserSerial", 0),
    ("pycreate2", "create2", "-", 0),
    ("yarc", "create2", "-", 0),
    ("create-serial", "create2", "-", 0),
    ("basicmicro", "roboclaw", "-", 0),
    ("pycreate2", "create2", DRIVE, 0),
    ("yarc", "create2", DRIVE, 0),
    ("basicmicro", "roboclaw", DRIVE, 0),
    ("kobukidriver", "kobuki", "-", 0),
]
MODULES = {"rplidar-roboticia": "rplidar", "adafruit-rplidar": "adafruit_rplidar", "pylidar3": "PyLidar3"}
FIELDS_DEG = {"hokuyo-urg": (-119.53125, 119.8828125), "hokuyo-utm": (-135.0, 135.0), "sick-lms291": (-90.0, 90.0)}
MRPT_INI = """
[global]
rawlog_prefix = {folder}/log
time_between_launches = 0
SF_max_time_span = 0.25
use_sensoryframes = 0
GRABBER_PERIOD_MS = 50
[LASER]
driver = {driver}
process_rate = 100
sensorLabel = LASER
COM_port_LIN = {port}
COM_baudRate = 38400
FOV = 180
resolution = 50
pose_x = 0
pose_y = 0
pose_z = 0
pose_yaw = 0
pose_pitch = 0
pose_roll = 0
"""


@dataclass
class Row:
    """What one client made of one device."""

    client: str
    device: str
    mode: str
    readings: int = 0
    median_m: float = math.nan
    p95_m: float = math.nan
    control_median_m: float = math.nan  # of the mirrored LIDAR, of the other wheel: must not fit
    verdict: str = ""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--python", default=shutil.which("python3"), help="an interpreter that has the PyPI clients")
    parser.add_argument("--only", default="", help="client or device")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    rows: list[Row] = []
    for case in CASES:
        if args.only in ("", *case):
            rows.append(judged(args.python, *case))
            row = figures(rows[-1])
            if not args.json:
                print(markdown([row]) if len(rows) == 1 else line(row, list(row)), flush=True)
    if args.json:
        print(json.dumps([asdict(row) for row in rows], indent=2))
    return int(any(row.verdict.startswith("WRONG") for row in rows))


def judged(python: str, client: str, device: str, mode: str, baud: int) -> Row:
    """A base is read once; a LIDAR twice, as it is and mirrored."""
    row = Row(client, device, mode)
    missing = why_absent(python, client)
    if missing:
        row.verdict = f"skipped: {missing}"
        return row
    if device in BASES and mode == DRIVE:
        errors, control = driven_errors_m(device, measured(python, client, device, mode, baud, []))
    elif device in BASES:
        read = measured(python, client, device, mode, baud, ["--explore", "--seed", str(ROBOT_SEED)])
        errors, control = way_errors_m(device, read)
    else:
        errors, control = (
            wall_errors_m(measured(python, client, device, mode, baud, standing + extra))
            for standing in (["--world", "room.txt", "--pose", f"{POSE.x_m},{POSE.y_m},{math.degrees(POSE.theta_rad)}"],)
            for extra in ([], ["--mirrored"])
        )
    row.readings = len(errors)
    if not len(errors) or not len(control):
        row.verdict = "WRONG: the client decoded nothing"
        return row
    row.median_m, row.p95_m = float(np.median(errors)), float(np.percentile(errors, 95))
    row.control_median_m = float(np.median(control))
    is_right = row.median_m < WANTED_M < row.control_median_m
    row.verdict = "right" if is_right else "WRONG: " + ("it does not fit" if row.median_m >= WANTED_M else "the control fits too")
    return row


def why_absent(python: str, client: str) -> str:
    """What to install; "" when it is there."""
    if client == "rawlog-grabber":
        return "" if shutil.which("rawlog-grabber") and shutil.which("rawlog-edit") else "apt-get install mrpt-apps"
    module = MODULES.get(client, client.replace("-", "_"))
    is_there = subprocess.run([python, "-c", f"import {module}"], capture_output=True, check=False).returncode == 0
    return "" if is_there else f"pip install {client} for {python}"


def measured(python: str, client: str, device: str, mode: str, baud: int, options: list[str]) -> Rows:
    """What the client read from the device."""
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        with serving(folder, device, options):
            if client == "rawlog-grabber":
                return by_mrpt(folder, device, mode)
            command = [python, str(FOREIGN), client, str(folder / "port"), mode, str(baud)]
            with contextlib.suppress(subprocess.TimeoutExpired):
                run = subprocess.run(command, capture_output=True, text=True, timeout=SECONDS, check=False)
                answers = [line for line in run.stdout.splitlines() if line.startswith("[[")]
                if answers:
                    return json.loads(answers[-1])  # type: ignore[no-any-return]
                print(f"{client} on {device}: {' '.join((run.stderr or run.stdout).split())[-300:]}", file=sys.stderr)
    return []


@contextlib.contextmanager
def serving(folder: Path, device: str, options: list[str]) -> Iterator[None]:
    """`mapquilt sim`, as a person starts it."""
    (folder / "room.txt").write_text("\n".join(" ".join(map(str, wall)) for wall in ROOM.segments.reshape(-1, 4).tolist()))
    command = [sys.executable, "-m", "agent", "-q", "sim", device, "--link", str(folder / "port"), "--noise", "0", *options]
    program = subprocess.Popen(command, cwd=folder, env={**os.environ, "PYTHONPATH": str(FOREIGN.parents[2])})
    try:
        until(lambda: (folder / "port").exists() or program.poll() is not None, 60.0, "the port")
        yield
    finally:
        program.send_signal(signal.SIGTERM)
        program.wait(20)


def by_mrpt(folder: Path, device: str, driver: str) -> Rows:
    """Grab for a few seconds, then write the scans of the log as text."""
    (folder / "grab.ini").write_text(MRPT_INI.format(folder=folder, driver=driver, port=folder / "port"))
    with (folder / "out").open("w") as out:
        command = ["rawlog-grabber", str(folder / "grab.ini")]
        grabber = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=out, stderr=out)
        time.sleep(SECONDS / 2)
        try:
            grabber.communicate(b"x", 8)  # it ends at the press of any key
        except subprocess.TimeoutExpired:
            grabber.kill()
    logs = sorted(folder.glob("log*.rawlog"))
    if not logs:
        print((folder / "out").read_text()[-400:])
        return []
    command = ["rawlog-edit", "-i", logs[0].name, "--export-2d-scans-txt"]  # a path with a folder is cut wrongly there
    subprocess.run(command, cwd=folder, capture_output=True, timeout=30, check=False)
    rows = [line.split() for path in folder.glob("log*LASER.txt") for line in path.read_text().splitlines() if line[:1] != "%"]
    return [beam for row in rows[-5:] for beam in scan_of(device, [float(word) for word in row[1:]])]


def scan_of(device: str, values: list[float]) -> Rows:
    """A line of an exported log: as many ranges as marks of which of them are valid."""
    n = len(values) // 2
    beams = zip(np.linspace(*FIELDS_DEG[device], n).tolist(), values[:n], values[n:], strict=True)
    return [[degrees, metres] for degrees, metres, is_valid in beams if is_valid]


def figures(row: Row) -> dict[str, object]:
    """As people read them."""
    return {
        "client": row.client,
        "device": row.device,
        "mode": row.mode,
        "readings": row.readings,
        "median": f"{1e3 * row.median_m:.1f} mm",
        "95 %": f"{1e3 * row.p95_m:.1f} mm",
        "mirrored, or the other wheel": f"{1e3 * row.control_median_m:.1f} mm",
        "verdict": row.verdict,
    }


if __name__ == "__main__":
    raise SystemExit(main())
