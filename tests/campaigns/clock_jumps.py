"""C13, clocks: the wall clock of every robot jumps by hours, days and decades while it maps and merges: nobody notices.

    .venv/bin/python -m tests.campaigns.clock_jumps [--robots 3] [--jumps 200] [--seed 1] [--json]

Robots run with a small library (built with the system's C compiler) before libc, which adds to the wall clock what a file
says: an hour or a day forward or back, or the years 1970 and 2038.  Every jump hits another robot than the last one; that
the clocks really jumped is read in the dates of the log lines.

Bars: 0 wrong decisions: no robot is lost, restarts, or leaves the group, no worker fails, and mapping goes on.
"""

from __future__ import annotations

import argparse
import random
import re
import shutil
import struct
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

from tests.bench.tables import print_row
from tests.harness.fleet import Fleet

LIBRARY = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/time.h>
#include <time.h>
static volatile long *shift;
__attribute__((constructor)) static void start(void) {
    int fd = open(getenv("WALL_CLOCK_SHIFT"), O_RDONLY);
    if (fd >= 0) shift = mmap(0, sizeof(long), PROT_READ, MAP_SHARED, fd, 0);
}
int clock_gettime(clockid_t id, struct timespec *ts) {
    static int (*real)(clockid_t, struct timespec *);
    if (!real) real = dlsym(RTLD_NEXT, "clock_gettime");
    int result = real(id, ts);
    if (shift && (id == CLOCK_REALTIME || id == CLOCK_REALTIME_COARSE)) ts->tv_sec += *shift;
    return result;
}
int gettimeofday(struct timeval *tv, void *zone) {
    struct timespec ts;
    clock_gettime(CLOCK_REALTIME, &ts);
    tv->tv_sec = ts.tv_sec; tv->tv_usec = ts.tv_nsec / 1000;
    return 0;
}
time_t time(time_t *out) {
    struct timespec ts;
    clock_gettime(CLOCK_REALTIME, &ts);
    if (out) *out = ts.tv_sec;
    return ts.tv_sec;
}
"""
HOUR_S, DAY_S = 3600, 86_400
YEAR_1970_S, YEAR_2038_S = 0, 2**31 + 60
MERGE_WITHIN_S = 120.0
LOOK_AFTER_S = 1.0


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, default=3)
    parser.add_argument("--jumps", type=int, default=200)
    parser.add_argument("--particles", type=int, default=8)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args(argv)
    if shutil.which("cc") is None:
        print("this campaign builds a small library and needs a C compiler (cc)", file=sys.stderr)
        return 2
    with tempfile.TemporaryDirectory(prefix="mq-") as folder:
        figures = Clocks(args, Path(folder)).run()
    print_row(figures, as_json=args.json)
    is_believed = {"1970", "2038"} <= set(figures["years in the logs"].split(", ")) or args.jumps < 50
    return 0 if figures["wrong decisions"] == 0 and is_believed else 1


class Clocks:
    """One campaign."""

    def __init__(self, args: argparse.Namespace, folder: Path) -> None:
        self.args, self.rng = args, random.Random(args.seed)
        self.folder = folder
        self.library = built(folder)
        self.wrong: Counter[str] = Counter()

    def run(self) -> dict[str, Any]:
        with Fleet() as fleet:
            stage = fleet.stage("office", robots=self.args.robots, seed=self.args.seed)
            few = ["--set", f"mapping.particles={self.args.particles}"]
            for actor in stage.robots:
                self.jump(actor.name, 0)
                clock = {"LD_PRELOAD": str(self.library), "WALL_CLOCK_SHIFT": str(self.shift_file(actor.name))}
                fleet.start(actor, arguments=few, environment=clock)
            fleet.begin(stage)
            names = [actor.name for actor in stage.robots]
            fleet.until(lambda: all(fleet.members(name) == sorted(names) for name in names), MERGE_WITHIN_S, "one map")
            boots = {name: fleet.status(name)["boot"] for name in names}
            scans = {name: fleet.status(name)["mapping"]["scans"] for name in names}
            for number in range(self.args.jumps):
                name = names[number % len(names)]
                self.jump(name, self.shift_s())
                time.sleep(LOOK_AFTER_S)  # as much as a beat needs to be heard
                scans = self.judge(fleet, names, boots, scans, number)
            lost = sum(fleet.status(name)["mapping"]["scans_lost"] for name in names)
            logs = [agent.log_path.read_text(errors="replace") for agent in fleet.agents.values()]
        return {
            "robots": self.args.robots,
            "jumps": self.args.jumps,
            "years in the logs": ", ".join(sorted(set(re.findall(r"^(\d{4})-", "\n".join(logs), re.MULTILINE)))),
            "wrong decisions": sum(self.wrong.values()) + sum(log.count(" ERROR ") for log in logs),
            "which": ", ".join(f"{what} {count}" for what, count in self.wrong.items()) or "none",
            "scans lost": lost,
        }

    def shift_s(self) -> int:
        now = int(time.time())
        jumps = [HOUR_S, -HOUR_S, DAY_S, -DAY_S, YEAR_1970_S - now, YEAR_2038_S - now, 0]
        return self.rng.choice(jumps)

    def shift_file(self, name: str) -> Path:
        return self.folder / f"{name}.shift"

    def jump(self, name: str, shift_s: int) -> None:
        """The clock of a robot is off by this much from now on: written in place, since the robot has the file mapped."""
        path = self.shift_file(name)
        with path.open("r+b" if path.exists() else "wb") as file:
            file.write(struct.pack("q", shift_s))

    def judge(self, fleet: Fleet, names: list[str], boots: dict[str, str], scans: dict[str, int], number: int) -> dict[str, int]:
        """Everybody is there, in one group, in the same life, and has mapped since the last look; the scans of each."""
        now = dict(scans)
        for name in names:
            status = fleet.status(name)
            peers = status.get("peers", [])
            wrong = {
                "silent": not status,
                "restarted": status.get("boot") != boots[name],
                "lost a peer": len(peers) != len(names) - 1 or any(peer["state"] == "lost" for peer in peers),
                "left the group": status.get("group") != sorted(names),
                "a worker failed": any(worker["errors"] for worker in status.get("workers", [])),
                "mapping stood still": status.get("mapping", {}).get("scans", 0) <= scans[name],
            }
            self.wrong.update(what for what, is_wrong in wrong.items() if is_wrong)
            if any(wrong.values()):
                print(f"jump {number}: {name}: {[what for what in wrong if wrong[what]]}", file=sys.stderr)
            now[name] = status.get("mapping", {}).get("scans", scans[name])
        return now


def built(folder: Path) -> Path:
    """The library that stands before libc."""
    source, library = folder / "wall_clock.c", folder / "wall_clock.so"
    source.write_text(LIBRARY)
    subprocess.run(["cc", "-shared", "-fPIC", "-O1", "-o", str(library), str(source), "-ldl"], check=True)
    return library


if __name__ == "__main__":
    sys.exit(main())
