"""C2: `kill -9` at any moment of the state writer, and of whole robots: nothing torn, every start succeeds.

    .venv/bin/python -m tests.campaigns.state_kills [--writers 10000] [--agents 500] [--naive 300] [--seed 1] [--json]

The writer is a child that saves one generation after another and says so after each; a killed one must leave the newest
generation it had said, or the one after.  A naive writer, which overwrites its file in place, shows that the campaign can
fail.  Robots run with simulated devices and save twice a second; some are killed while they start.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import logging
import os
import random
import re
import signal
import statistics
import struct
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

from agent.commands.children import AgentProcess, ChildError
from agent.runtime.state import CorruptState, StateDirectory, pack, unpack
from tests.bench.tables import print_rows
from tests.harness.processes import percentile

NAME = "mapper"
MAX_BYTES = 64 * 1024
WHILE_STARTING = 0.2  # share of the robots that are killed before they are up
SAID = struct.Struct("<I")

Save = Callable[[StateDirectory, bytes], object]


@dataclass
class Tally:
    """What the kills of one kind of victim did."""

    victim: str
    kills: int = 0
    torn: int = 0  # files under their final name that do not read as written
    failed_starts: int = 0
    lost: int = 0  # generations that had been said to be on disk and were not found
    generations: int = 0
    seconds: float = 0.0
    ready_s: list[float] = field(default_factory=list)

    def row(self) -> dict[str, object]:
        """One line of the table."""
        ready = sorted(self.ready_s)
        figures = asdict(self) | {"seconds": round(self.seconds, 1)}
        figures.pop("ready_s")
        if len(ready) > 1:
            figures |= {"READY p50 s": round(statistics.median(ready), 2), "READY p99 s": round(percentile(ready, 0.99), 2)}
            figures |= {"READY worst s": round(ready[-1], 2), "load": round(os.getloadavg()[1], 1)}
        return figures

    @property
    def holds(self) -> bool:
        return not (self.torn or self.failed_starts or self.lost)


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--writers", type=int, default=10_000)
    parser.add_argument("--agents", type=int, default=500)
    parser.add_argument("--naive", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args(argv)
    rng = random.Random(args.seed)
    logging.disable(logging.WARNING)  # the naive writer's torn files are counted, not told one by one
    with tempfile.TemporaryDirectory(prefix="mq-") as folder:
        whole = kill_writers(Path(folder) / "writer", args.writers, rng, save_whole, "state writer")
        naive = kill_writers(Path(folder) / "naive", args.naive, rng, save_in_place, "naive writer, for comparison")
        agents = kill_agents(Path(folder), args.agents, rng)
    rows = [tally.row() for tally in (whole, naive, agents) if tally.kills]
    print_rows(rows, as_json=args.json)
    return 0 if whole.holds and agents.holds else 1


# The writer.


def save_whole(state: StateDirectory, payload: bytes) -> object:
    return state.save(NAME, payload)


def save_in_place(state: StateDirectory, payload: bytes) -> object:
    state.folder.mkdir(exist_ok=True)
    return (state.folder / f"{NAME}.1.state").write_bytes(pack(payload))


def kill_writers(folder: Path, kills: int, rng: random.Random, save: Save, victim: str) -> Tally:
    tally, started, number = Tally(victim), time.monotonic(), 0
    while tally.kills < kills:
        said = killed_writer(folder, number, rng, save)
        tally.torn += torn(folder)
        found = StateDirectory(folder).load(NAME)
        tally.kills += 1
        if found is None:
            tally.failed_starts += 1
            number = said
            continue
        number = SAID.unpack_from(found)[0]
        tally.failed_starts += found != content(number)
        tally.lost += max(0, said - number)
    tally.generations, tally.seconds = number, time.monotonic() - started
    return tally


def killed_writer(folder: Path, number: int, rng: random.Random, save: Save) -> int:
    """Fork a writer that goes on from `number`, kill it a moment after its first word; the last generation it said."""
    out, into = os.pipe()
    delay_s = rng.uniform(0.0, 0.006)
    child = os.fork()
    if child == 0:
        with contextlib.suppress(BaseException):
            state = StateDirectory(folder)
            while save(state, content(number := number + 1)):
                os.write(into, SAID.pack(number))
        os._exit(1)
    os.close(into)
    said = os.read(out, SAID.size)
    time.sleep(delay_s)  # the moment of the kill
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    while part := os.read(out, 4096):
        said += part
    os.close(out)
    return int(SAID.unpack(said[-SAID.size :])[0])


def content(number: int) -> bytes:
    """What generation `number` holds: its number, and bytes of its own, sometimes many."""
    return SAID.pack(number) + random.Random(number).randbytes(number * 7919 % MAX_BYTES)


def torn(folder: Path) -> int:
    """Files that claim to be whole and are not."""
    count = 0
    for path in folder.glob("*.state"):
        try:
            unpack(path.read_bytes())
        except CorruptState:
            count += 1
    return count


# The robot.


def kill_agents(folder: Path, kills: int, rng: random.Random) -> Tally:
    tally = Tally("whole robot")
    saved = folder / "mapquilt" / "victim"
    if kills:
        first = robot("first", folder)  # not counted: it may have to compile what an installed robot has compiled
        first.wait_ready()
        first.stop()
    started = time.monotonic()
    while tally.kills < kills:
        before = newest_generation(saved)
        begun = time.monotonic()
        agent = robot("victim", folder)
        if rng.random() < WHILE_STARTING:
            time.sleep(rng.uniform(0.0, 1.5))  # the moment of the kill
        else:
            try:
                agent.wait_ready()
                tally.ready_s.append(time.monotonic() - begun)
            except ChildError as error:
                tally.failed_starts += 1
                print(error, file=sys.stderr)
            time.sleep(rng.uniform(0.0, 2.0))
        seen = newest_generation(saved)
        agent.kill()
        tally.kills += 1
        tally.torn += torn(saved)
        tally.lost += max(0, seen - newest_generation(saved))
        log = agent.log_path.read_text(errors="replace")
        tally.failed_starts += bool(before) and "up fleet" in log and "restored the local map" not in log
        tally.failed_starts += bool(re.search(r"set aside|does not fit|Traceback", log))
        agent.log_path.unlink()
        tally.generations = newest_generation(saved)
        if tally.kills % 25 == 0:
            print(f"{tally.kills} robots: {json.dumps(tally.row())}", file=sys.stderr)
    tally.seconds = time.monotonic() - started
    return tally


def robot(name: str, folder: Path) -> AgentProcess:
    return AgentProcess(name, ["--lidar", "sim:office?seed=3", "--no-view", "--set", "state.save_every_s=0.5"], folder)


def newest_generation(folder: Path) -> int:
    return max((int(path.name.split(".")[1]) for path in folder.glob(f"{NAME}.*.state")), default=0)


if __name__ == "__main__":
    raise SystemExit(main())
