"""C13, signals: SIGTERM and SIGINT at any moment of a real robot: it ends soon, says how, leaves nobody behind and its map whole.

    .venv/bin/python -m tests.campaigns.signals [--signals 500] [--seed 1] [--json]

A companion robot keeps running; the victim starts, dials it, maps, merges and saves, and is told to stop after a random time,
short ones more often: while Python imports, while the network opens, while it maps, merges, or writes its state.

Bars: exit within 2 s (p99), exit code 0 once it was up and that of the signal before, no process left, state readable.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

from agent.commands.children import AgentProcess
from tests.bench.tables import print_row
from tests.campaigns.state_kills import NAME, torn
from tests.harness.processes import percentile

SHORTEST_S, LONGEST_S = 0.05, 6.0
LEAVE_WITHIN_S = 14.0  # the robot's own watchdog ends it after 12 s
STAGES = {"merged": "merged a=", "mapping": "up fleet="}  # in the log, the latest first


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--signals", type=int, default=500)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args(argv)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores it, and so would its children
    campaign = Signals(random.Random(args.seed))
    with tempfile.TemporaryDirectory(prefix="mq-") as folder:
        figures = campaign.run(Path(folder), args.signals)
    print_row(figures, as_json=args.json)
    wrong = ("wrong exit codes", "left behind", "torn states", "tracebacks", "forced")
    return 0 if not any(figures[name] for name in wrong) and figures["exit p99 s"] <= 2.0 else 1


class Signals:
    """One campaign."""

    def __init__(self, rng: random.Random) -> None:
        self.rng = rng
        self.exits_s: list[float] = []
        self.stages: Counter[str] = Counter()
        self.counts: Counter[str] = Counter()

    def run(self, folder: Path, signals: int) -> dict[str, Any]:
        companion = self.robot("companion", 1, folder, [])
        try:
            locator = companion.wait_ready()["locators"][0]
            for number in range(signals):
                self.one(folder, locator)
                if number % 25 == 24:
                    print(f"{number + 1}: {dict(self.stages)} p99 {percentile(self.exits_s, 0.99):.2f} s", file=sys.stderr)
        finally:
            companion.stop()
        return {
            "signals": signals,
            **{f"while {stage}": self.stages[stage] for stage in ("starting", "mapping", "merged")},
            "exit p50 s": percentile(self.exits_s, 0.5),
            "exit p99 s": percentile(self.exits_s, 0.99),
            "worst s": max(self.exits_s, default=0.0),
            **{name: self.counts[name] for name in ("wrong exit codes", "left behind", "torn states", "tracebacks", "forced")},
            "generations saved": newest(folder),
        }

    def robot(self, name: str, start: int, folder: Path, more: list[str]) -> AgentProcess:
        words = ["--lidar", f"sim:office?seed=3&start={start}", "--no-view", "--set", "mapping.particles=5"]
        return AgentProcess(name, [*words, *more], folder)

    def one(self, folder: Path, locator: str) -> None:
        """Start the victim, wait, tell it to stop, look at what it leaves."""
        victim = self.robot("victim", 0, folder, ["--connect", locator, "--set", "state.save_every_s=0.5"])
        time.sleep(SHORTEST_S * (LONGEST_S / SHORTEST_S) ** self.rng.random())  # the moment of the signal
        number = self.rng.choice([signal.SIGTERM, signal.SIGINT])
        log = victim.log_path.read_text(errors="replace")
        stage = next((name for name, line in STAGES.items() if line in log), "starting")
        told_s = time.monotonic()
        victim.signal(number)
        try:
            code = victim.process.wait(LEAVE_WITHIN_S)
        except subprocess.TimeoutExpired:
            code = victim.kill()
        self.exits_s.append(time.monotonic() - told_s)
        self.stages[stage] += 1
        self.judge(victim, code, number, stage, folder)

    def judge(self, victim: AgentProcess, code: int, number: int, stage: str, folder: Path) -> None:
        log = victim.log_path.read_text(errors="replace")
        told = {0} if stage != "starting" else {0, -number, 128 + number}
        is_interrupted_import = stage == "starting" and "KeyboardInterrupt" in log  # what any Python program says
        if is_interrupted_import and "/agent/" not in log:  # before the first line of ours: the interpreter's own code
            told = {*told, 1}
        wrong = {
            "wrong exit codes": code not in told,
            "left behind": is_anybody_left(victim.process.pid),
            "torn states": torn(folder / "mapquilt" / "victim") > 0,
            "tracebacks": "Traceback" in log and not is_interrupted_import,
            "forced": "took too long" in log or "left behind" in log,
        }
        self.counts.update(name for name, is_wrong in wrong.items() if is_wrong)
        if any(wrong.values()):
            print(f"{number.name} while {stage}: code {code}, {[w for w in wrong if wrong[w]]}\n{log[-1500:]}", file=sys.stderr)
        victim.stop()  # closes what we hold of it
        victim.log_path.unlink()


def is_anybody_left(group: int) -> bool:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(group, 0)
        return True
    return False


def newest(folder: Path) -> int:
    """The number of the victim's newest generation: how often it saved in all."""
    names = (path.name.split(".")[1] for path in (folder / "mapquilt" / "victim").glob(f"{NAME}.*.state"))
    return max(map(int, names), default=0)


if __name__ == "__main__":
    sys.exit(main())
