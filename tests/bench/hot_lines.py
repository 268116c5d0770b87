"""Where a robot's CPU time goes: the most expensive lines of the whole system, by sampling a replayed run.

    .venv/bin/python -m tests.bench.hot_lines [--seconds 60] [--particles 30] [--top 10] [--json]

Two robots in the simulated office, recorded first, so that the simulator does not count; then both robots' whole logic, from
the LIDAR's bytes to the global map, runs on one thread while a timer of CPU time notes which line is being worked on.
"""

from __future__ import annotations

import argparse
import json
import linecache
import signal
import time
from collections import Counter
from pathlib import Path
from types import FrameType

import cv2

from tests.bench.tables import markdown
from tests.harness import golden

ROOT = Path(__file__).resolve().parents[2]
EVERY_S = 0.001
ROOMS = {
    "hw": "senses",
    "agent/mapping": "mapping",
    "agent/features": "features",
    "agent/merging": "merging",
    "agent/fleet": "fleet",
}


class Sampler:
    """Counts the innermost line of our own code that is running, every millisecond of CPU time."""

    def __init__(self) -> None:
        self.lines: Counter[tuple[str, int]] = Counter()

    def __enter__(self) -> Sampler:
        signal.signal(signal.SIGPROF, self._look)
        signal.setitimer(signal.ITIMER_PROF, EVERY_S, EVERY_S)
        return self

    def __exit__(self, *_: object) -> None:
        signal.setitimer(signal.ITIMER_PROF, 0.0)

    def _look(self, _: int, frame: FrameType | None) -> None:
        while frame is not None:
            name = frame.f_code.co_filename
            if name.startswith(f"{ROOT}/") and "/.venv/" not in name:
                self.lines[name.removeprefix(f"{ROOT}/"), frame.f_lineno] += 1
                return
            frame = frame.f_back


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--particles", type=int, default=30)
    parser.add_argument("--top", type=int, default=10)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args(argv)
    cv2.setNumThreads(1)
    run = golden.drive(seconds=args.seconds, spacing_m=4.5)
    started = time.process_time()
    with Sampler() as sampler:
        robots, _ = golden.replay_all(run, args.particles)
    cpu_s = time.process_time() - started
    figures = {
        "CPU s": round(cpu_s, 1),
        "share of a core a robot": round(cpu_s / args.seconds / len(robots), 3),
        "rooms": shares(sampler.lines),
        "lines": [line(place, n, sampler.lines.total()) for place, n in sampler.lines.most_common(args.top)],
    }
    print(json.dumps(figures) if args.json else table(figures))
    return 0


def shares(lines: Counter[tuple[str, int]]) -> dict[str, float]:
    """Of the samples, by room."""
    rooms: Counter[str] = Counter()
    for (name, _), n in lines.items():
        rooms[next((room for folder, room in ROOMS.items() if name.startswith(folder)), "else")] += n
    return {room: round(n / lines.total(), 3) for room, n in rooms.most_common()}


def line(place: tuple[str, int], n: int, total: int) -> tuple[float, str, str]:
    name, number = place
    return round(n / total, 3), f"{name}:{number}", linecache.getline(str(ROOT / name), number).strip()


def table(figures: dict[str, object]) -> str:
    head = [f"{name}: {figures[name]}" for name in ("CPU s", "share of a core a robot", "rooms")]
    lines = figures["lines"]
    rows = [{"share": f"{share:.1%}", "line": place, "": f"`{text}`"} for share, place, text in lines]  # type: ignore[attr-defined]
    return "\n".join([*head, "", markdown(rows)])


if __name__ == "__main__":
    raise SystemExit(main())
