"""Other people's software connects to our simulated LIDARs and measures the room they stand in: are our bytes right?

    python3 -m venv /tmp/clients && /tmp/clients/bin/pip install rplidar-roboticia pyrplidar lds2d
    apt-get install mrpt-apps                                            # rawlog-grabber, for Hokuyo and SICK
    .venv/bin/python -m tests.campaigns.independent_clients --python /tmp/clients/bin/python

Every client decodes each device of the protocol it knows; the median difference from the walls must be below a centimetre.  The
same devices, mirrored, must fail: else the check would prove nothing.  A client that is not installed is left out, and said so.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from hw.sim.catalogue import LIDARS
from hw.sim.raycast import cast_all
from hw.sim.sight import Sight, Standing
from hw.sim.sim_port import PtyServer
from tests.harness.serial_device import POSE, ROOM

WANTED_M = 0.01
SECONDS = 20.0
Beams = list[tuple[float, float]]  # (degrees counter-clockwise, metres)

PYTHON_CLIENTS = {  # each prints [[degrees clockwise, millimetres], ...] of a few turns as JSON
    "rplidar-roboticia": """
import json, sys
from rplidar import RPLidar
lidar = RPLidar(sys.argv[1], int(sys.argv[3]))
lidar.start_motor = lidar.stop_motor = lambda: None  # a pty has no DTR line
lidar.get_info(); lidar.get_health()
scans = []
for scan in lidar.iter_scans(sys.argv[2], max_buf_meas=False):
    scans.append(scan)
    if len(scan) and len(scans) == 4:
        break
lidar.stop()
print(json.dumps([[angle, mm] for scan in scans[1:] for _, angle, mm in scan]))
""",
    "pyrplidar": """
import itertools, json, sys, time
from pyrplidar import PyRPlidar
lidar = PyRPlidar()
lidar.connect(port=sys.argv[1], baudrate=int(sys.argv[3]), timeout=3)
lidar.get_info(); lidar.get_health()
scan = lidar.start_scan() if sys.argv[2] == "standard" else lidar.start_scan_express(int(sys.argv[2]))
beams = [[m.angle, m.distance] for m in itertools.islice(scan(), 3000)]
lidar.stop()
print(json.dumps(beams))
""",
    "lds2d": """
import itertools, json, sys, types
from lds2d import Lidar, NotSupportedError
still = types.SimpleNamespace(set_duty=lambda duty: None, close=lambda: None)  # the XV-11's host drives its motor
lidar = Lidar.open(sys.argv[2], sys.argv[1], **({"motor": still} if sys.argv[2] == "XV11" else {}))
try:
    lidar.start()
except NotSupportedError:
    pass
beams = [[p.angle_deg, p.dist_mm] for p in itertools.islice(lidar.points(), 3000)]
print(json.dumps(beams))
""",
}
# lds2d reads an LDS-01 one degree off the maker's own ROS driver, which we follow, so that pair is not here.
CASES = [  # (client, device, what the client is told)
    ("rplidar-roboticia", "rplidar-a1", "normal"),
    ("pyrplidar", "rplidar-a1", "standard"),
    ("pyrplidar", "rplidar-a1", "1"),
    ("pyrplidar", "rplidar-a1", "2"),
    ("pyrplidar", "rplidar-c1", "standard"),
    ("lds2d", "rplidar-a1", "RPLIDAR-A1"),
    ("lds2d", "rplidar-c1", "RPLIDAR-C1"),
    ("lds2d", "ld06", "LD06"),
    ("lds2d", "ld19", "LD19"),
    ("lds2d", "ydlidar-x2", "YDLIDAR-X2"),
    ("lds2d", "ydlidar-x4", "YDLIDAR-X4"),
    ("lds2d", "xv11", "XV11"),
    ("rawlog-grabber", "hokuyo-urg", "CHokuyoURG"),
    ("rawlog-grabber", "hokuyo-utm", "CHokuyoURG"),
    ("rawlog-grabber", "sick-lms291", "CSickLaserSerial"),
]
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
    beams: int = 0
    median_m: float = math.nan
    p95_m: float = math.nan
    mirrored_median_m: float = math.nan
    verdict: str = ""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--python", default=shutil.which("python3"), help="an interpreter that has the PyPI clients")
    parser.add_argument("--only", default="", help="client or device")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    rows = [judged(args.python, *case) for case in CASES if args.only in ("", *case)]
    print(json.dumps([asdict(row) for row in rows], indent=2) if args.json else table(rows))
    return int(any(row.verdict.startswith("WRONG") for row in rows))


def judged(python: str, client: str, device: str, mode: str) -> Row:
    """Two runs: the device as it is, and mirrored."""
    row = Row(client, device, mode)
    missing = why_absent(python, client)
    if missing:
        row.verdict = f"skipped: {missing}"
        return row
    errors, mirrored = (errors_m(measured(python, client, device, mode, is_mirrored)) for is_mirrored in (False, True))
    row.beams = len(errors)
    if not len(errors) or not len(mirrored):
        row.verdict = "WRONG: the client decoded nothing"
        return row
    row.median_m, row.p95_m, row.mirrored_median_m = (
        float(np.median(errors)),
        float(np.percentile(errors, 95)),
        float(np.median(mirrored)),
    )
    is_right = row.median_m < WANTED_M < row.mirrored_median_m
    row.verdict = (
        "right" if is_right else "WRONG: " + ("ranges do not fit" if row.median_m >= WANTED_M else "a mirrored device fits too")
    )
    return row


def why_absent(python: str, client: str) -> str:
    """What to install; "" when it is there."""
    if client == "rawlog-grabber":
        return "" if shutil.which("rawlog-grabber") and shutil.which("rawlog-edit") else "apt-get install mrpt-apps"
    module = {"rplidar-roboticia": "rplidar"}.get(client, client)
    is_there = subprocess.run([python, "-c", f"import {module}"], capture_output=True, check=False).returncode == 0
    return "" if is_there else f"pip install {client} for {python}"


def measured(python: str, client: str, device: str, mode: str, is_mirrored: bool) -> Beams:
    """What the client read from the device."""
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        simulated = LIDARS[device][0](Sight(Standing(ROOM, POSE), noise_m=0.0, is_mirrored=is_mirrored))
        with PtyServer([(simulated, folder / "port")]):
            if client == "rawlog-grabber":
                return by_mrpt(folder, device, mode)
            command = [python, "-c", PYTHON_CLIENTS[client], str(folder / "port"), mode, str(simulated.baud)]
            with contextlib.suppress(subprocess.TimeoutExpired):
                run = subprocess.run(command, capture_output=True, text=True, timeout=SECONDS, check=False)
                answers = [line for line in run.stdout.splitlines() if line.startswith("[[")]
                if answers:
                    return [(-degrees, mm / 1e3) for degrees, mm in json.loads(answers[-1])]
                print(f"{client} on {device}: {' '.join((run.stderr or run.stdout).split())[-300:]}", file=sys.stderr)
    return []


def by_mrpt(folder: Path, device: str, driver: str) -> Beams:
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


def scan_of(device: str, values: list[float]) -> Beams:
    """A line of an exported log: as many ranges as marks of which of them are valid."""
    n = len(values) // 2
    beams = zip(np.linspace(*FIELDS_DEG[device], n).tolist(), values[:n], values[n:], strict=True)
    return [(degrees, metres) for degrees, metres, is_valid in beams if is_valid]


def errors_m(beams: Beams) -> np.ndarray:
    """How far each range is from the wall at its bearing."""
    seen = np.array([beam for beam in beams if 0.05 < beam[1] < 20.0]).reshape(-1, 2)
    bearings = POSE.theta_rad + np.radians(seen[:, 0])
    origins = np.tile([POSE.x_m, POSE.y_m], (len(seen), 1))
    return np.abs(cast_all(ROOM.segments, origins, bearings, 100.0) - seen[:, 1])


def table(rows: list[Row]) -> str:
    """Markdown."""
    lines = [
        "| client | device | mode | beams | median | 95 % | mirrored | verdict |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for row in rows:
        figures = [f"{1e3 * value:.1f} mm" for value in (row.median_m, row.p95_m, row.mirrored_median_m)]
        lines.append(f"| {row.client} | {row.device} | {row.mode} | {row.beams} | {' | '.join(figures)} | {row.verdict} |")
    return "\n".join(lines)


if __name__ == "__main__":
    raise SystemExit(main())
