"""A whole agent at work: CPU, memory and lost scans of the real process, fed by a simulated robot in another process.

    .venv/bin/python -m tests.bench.agent_cpu [--seconds 120] [--lidar ld19] [--json]

`mapquilt sim DEVICE --explore --also wt1` drives through a building and serves the LIDAR's and the encoder board's bytes on
ptys in real time; `mapquilt run` maps, makes features, looks for peers, serves its page and saves its state.  CPU is that of
the agent's process, all threads, user and system, from /proc, in the steady state after the first ten seconds.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from tests.bench.tables import print_row
from tests.harness.processes import cpu_s, peak_mb, resident_mb

MAPQUILT = [str(Path(sys.executable).with_name("mapquilt"))]
WARM_UP_S = 10.0
START_WITHIN_S = 60.0
BAR_CPU = 0.25


def status(robot: str) -> dict[str, object]:
    """What the agent says of its mapping; empty while it does not answer."""
    done = subprocess.run([*MAPQUILT, "status", "--json", "--robot", robot], capture_output=True, text=True, check=False)
    lines = [line for line in done.stdout.splitlines() if line.startswith("{")]
    return dict(json.loads(lines[0]).get("mapping", {})) if lines else {}


def measure(lidar: str, world: str, seconds: float, folder: Path) -> dict[str, object]:
    """Start both, wait for the first scans, watch."""
    robot = f"bench-{os.getpid()}"
    ports = {name: folder / name for name in ("lidar", "wheels")}
    wheels = ["--also", f"wt1={ports['wheels']}"]
    simulator = subprocess.Popen(
        [*MAPQUILT, "sim", lidar, "--link", str(ports["lidar"]), *wheels, "--explore", "--world", world],
        stdout=subprocess.DEVNULL,
    )
    scheme = {"ld19": "ld06", "rplidar-c1": "rplidar", "rplidar-s2": "rplidar"}.get(lidar, lidar.partition("-")[0])
    agent = None
    try:
        wait_until(lambda: all(path.exists() for path in ports.values()), "the simulator's ports")
        agent = subprocess.Popen(
            [*MAPQUILT, "run", "--id", robot, "--lidar", f"{scheme}:{ports['lidar']}", "--wheels", f"wheels:{ports['wheels']}",
             "--state-dir", str(folder / "state"), "--view-port", "0", "--die-with-parent", str(os.getpid())],
            stdout=subprocess.DEVNULL,
        )  # fmt: skip
        wait_until(lambda: int(str(status(robot).get("scans", 0))) > 0, "the first scan")
        time.sleep(WARM_UP_S)
        return watched(robot, agent.pid, lidar, world, seconds)
    finally:
        for process in (agent, simulator):
            if process is not None:
                process.terminate()
                process.wait(10.0)


def watched(robot: str, pid: int, lidar: str, world: str, seconds: float) -> dict[str, object]:
    before, cpu_before_s, begun_s = status(robot), cpu_s(pid), time.monotonic()
    time.sleep(seconds)
    spent_s, wall_s = cpu_s(pid) - cpu_before_s, time.monotonic() - begun_s
    after = status(robot)
    scans = int(str(after["scans"])) - int(str(before["scans"]))
    return {
        "lidar": lidar,
        "world": world,
        "seconds": round(wall_s, 1),
        "scans a second": round(scans / wall_s, 2),
        "CPU of one core": round(spent_s / wall_s, 3),
        "bar": BAR_CPU,
        "mapping ms a scan": after["cpu_ms_per_scan"],
        "scans lost": int(str(after["scans_lost"])) - int(str(before["scans_lost"])),
        "lost before": int(str(before["scans_lost"])),
        "RSS MB": round(resident_mb(pid), 1),
        "peak MB": round(peak_mb(pid), 1),
        "known m2": after.get("known_m2"),
        "load": round(os.getloadavg()[0], 1),
    }


def wait_until(is_so: Callable[[], bool], what: str) -> None:
    deadline_s = time.monotonic() + START_WITHIN_S
    while not is_so():
        if time.monotonic() > deadline_s:
            raise SystemExit(f"agent_cpu: {what} did not come within {START_WITHIN_S:.0f} s")
        time.sleep(0.2)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=120.0)
    parser.add_argument("--lidar", default="ld19", help="a device of `mapquilt sim`: ld19 has 450 beams at 10 Hz")
    parser.add_argument("--world", default="office?seed=1")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        row = measure(arguments.lidar, arguments.world, arguments.seconds, Path(folder))
    print_row(row, as_json=arguments.json)


if __name__ == "__main__":
    main()
