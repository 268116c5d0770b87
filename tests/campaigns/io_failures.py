"""C3: every single call on the robot's disk fails, once or from then on: no crash, it is said, and it is over when it is over.

    .venv/bin/python -m tests.campaigns.io_failures [--every 1] [--no-robot] [--json]

First the scripted minute of `tests/harness/disk_work.py`, again and again, each time with another call failing, with each of
four errors; the fault "for ever" ends 10 seconds before the minute does.  Then a whole running robot whose kernel refuses to
let files grow (EFBIG), and to open any more (EMFILE).
"""

from __future__ import annotations

import argparse
import errno
import json
import logging
import resource
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from agent.commands.children import AgentProcess
from agent.runtime.control import ControlError
from tests.bench.tables import markdown
from tests.harness.disk_work import SECONDS, live
from tests.harness.failing_disk import FailingDisk
from tests.harness.waiting import until

ERRORS = (errno.ENOSPC, errno.EIO, errno.EROFS, errno.EMFILE)
IN_MEMORY = "/dev/shm" if Path("/dev/shm").is_dir() else None  # a real disk's fsync takes most of the hours
HEAL_AT_S = SECONDS - 10
FAULT_S = 3.0


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--every", type=int, default=1, help="only every so manieth call")
    parser.add_argument("--no-robot", action="store_true", help="only the scripted minute")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args(argv)
    logging.disable(logging.CRITICAL)
    rows = [scripted(args.every)] + ([] if args.no_robot else list(on_a_robot()))
    if args.json:
        print("\n".join(json.dumps(row) for row in rows))
    else:
        columns = ("what", "runs", "failed calls", "crashes", "wrong", "which calls")
        print(markdown([dict(zip(columns, row.values(), strict=True)) for row in rows]))
    return 1 if any(row["crashes"] or row["wrong"] for row in rows) else 0


def scripted(every: int) -> dict[str, Any]:
    """The minute, with every call failing in turn."""
    runs = failures = crashes = wrong = 0
    kinds: Counter[str] = Counter()
    for for_ever in (False, True):
        for error in ERRORS:
            for number in range(1, calls_of_a_minute() + 1, every):
                runs += 1
                with tempfile.TemporaryDirectory(dir=IN_MEMORY) as folder, FailingDisk(Path(folder)) as disk:
                    before = live(Path(folder) / "r1", disk)
                    disk.fail(number, error, for_ever=for_ever)
                    try:
                        complaints = live(Path(folder) / "r1", disk, HEAL_AT_S, before).wrong
                    except Exception:
                        traceback.print_exc()
                        crashes, complaints = crashes + 1, []
                failures += disk.failures
                kinds.update(disk.failed)
                wrong += bool(complaints)
                for complaint in complaints:
                    print(f"call {number}, {errno.errorcode[error]}, for ever {for_ever}: {complaint}", file=sys.stderr)
    which = ", ".join(f"{name} {count}" for name, count in kinds.most_common())
    return {"what": "scripted minute", "runs": runs, "failed": failures, "crashes": crashes, "wrong": wrong, "calls": which}


def calls_of_a_minute() -> int:
    with tempfile.TemporaryDirectory(dir=IN_MEMORY) as folder, FailingDisk(Path(folder)) as disk:
        live(Path(folder) / "r1", disk)
        first = disk.calls
        live(Path(folder) / "r1", disk)
        return disk.calls - first


def on_a_robot() -> Iterator[dict[str, Any]]:
    """A running robot under limits of the kernel: it maps on, says so, and saves again when they are lifted."""
    with tempfile.TemporaryDirectory(prefix="mq-") as folder:
        settings = ["--lidar", "sim:office?seed=3", "--no-view", "--set", "state.save_every_s=0.5"]
        robot = AgentProcess("r1", settings, Path(folder))
        try:
            robot.wait_ready()
            until(lambda: robot.status()["mapping"]["scans"] > 5, 20.0, "mapping")
            yield limited(robot, "files may not grow (EFBIG)", resource.RLIMIT_FSIZE, 0)
            yield limited(robot, "no file can be opened (EMFILE)", resource.RLIMIT_NOFILE, 3)
        finally:
            robot.stop()


def limited(robot: AgentProcess, what: str, limit: int, soft: int) -> dict[str, Any]:
    before = resource.prlimit(robot.process.pid, limit)
    scans = robot.status()["mapping"]["scans"]
    resource.prlimit(robot.process.pid, limit, (soft, before[1]))
    told = []
    ends_s = time.monotonic() + FAULT_S
    while time.monotonic() < ends_s:  # under EMFILE it cannot even accept us: it must be seen by what it says afterwards
        told += complaints(robot)
        time.sleep(0.1)
    resource.prlimit(robot.process.pid, limit, before)
    wrong = []
    if limit == resource.RLIMIT_FSIZE and not told:
        wrong.append("nothing is said")
    try:
        until(lambda: answers(robot) and not complaints(robot), 20.0, "recovery")
    except AssertionError:
        wrong.append(f"it does not recover: {complaints(robot)}")
    if not answers(robot) or robot.status()["mapping"]["scans"] < scans + FAULT_S * 5:
        wrong.append("mapping stood still")
    print(f"{what}: {wrong or 'fine'} {sorted(set(told))}", file=sys.stderr)
    crashes = (not robot.is_running) + robot.log_path.read_text(errors="replace").count("Traceback")
    return {"what": what, "runs": 1, "failed": f"{FAULT_S:.0f} s", "crashes": crashes, "wrong": len(wrong), "calls": ""}


def complaints(robot: AgentProcess) -> list[str]:
    """Of its disk: a busy computer may have others."""
    try:
        return [problem for problem in robot.status()["problems"] if problem.startswith(("state", "records"))]
    except ControlError:
        return []


def answers(robot: AgentProcess) -> bool:
    try:
        return bool(robot.status())
    except ControlError:
        return False


if __name__ == "__main__":
    raise SystemExit(main())
