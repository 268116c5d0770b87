"""`mapquilt report [DIR ...] -o report.html`: what happened in a run, for a person: every merge attempt, and why it ended so."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from agent.commands.files import written_file
from agent.config import state_dir
from agent.config_flags import add_config_arguments, load_from
from agent.exits import BAD_INPUT, OK, CommandError
from agent.mapping.mapper import Mapper
from agent.runtime.settings import mapping_options
from agent.runtime.state import StateDirectory
from agent.view.render import map_picture, png
from agent.view.report_page import RobotReport, report_page
from protocol.geometry import SE2

EXAMPLES = """\
  mapquilt report                                        the robot of these settings, into report.html
  mapquilt report ~/.local/state/mapquilt/* -o run.html  several robots on one page
  sudo mapquilt report /var/lib/mapquilt/robot-1         a service's robot
"""

RECORD_FILES = ("records.old.jsonl", "records.jsonl")
MAX_RECORDS = 20_000
MAX_LINE_BYTES = 64 * 1024


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "dirs", nargs="*", type=Path, metavar="DIR", help="state directories (default: the one of these settings)"
    )
    parser.add_argument(
        "-o", "--output", type=Path, default=Path("report.html"), metavar="FILE.html", help="default: report.html"
    )
    add_config_arguments(parser, "robot.id", "state")


def run(args: argparse.Namespace) -> int:
    config = load_from(args).config
    own = state_dir(config, os.environ)
    folders = args.dirs or [own]
    robots = [report_of(folder, config.robot.id if folder == own else folder.name, config) for folder in folders]
    if not any(robot.records or robot.pictures for robot in robots):
        places = ", ".join(map(str, folders))
        raise CommandError(f"{places}: neither records nor a map; give the state directory of a robot that ran", BAD_INPUT)
    title = f"mapquilt: {', '.join(robot.robot for robot in robots)}"
    written_file(args.output, report_page(robots, title).encode())
    if not args.quiet:
        print(f"wrote {args.output}", file=sys.stderr)
    return OK


def report_of(folder: Path, robot: str, config: Any) -> RobotReport:
    """Records and map of one state directory; what is not there, or does not read, is left out."""
    records = [record for name in RECORD_FILES for record in read_records(folder / name)][-MAX_RECORDS:]
    attempts = [record for record in records if record.get("event") == "merge-attempt"]
    merged = {str(record.get("peer")) for record in attempts if record.get("status") == "merged"}
    figures = [
        ("records", str(len(records))),
        ("merge attempts", str(len(attempts))),
        ("found a fit with", ", ".join(sorted(merged)) or "nobody"),
    ]
    if records:
        figures.insert(0, ("time", span(str(records[0].get("time", "?")), str(records[-1].get("time", "?")))))
    pictures = []
    saved = StateDirectory(folder).load("mapper")
    if saved is not None:
        try:
            estimate = Mapper.restore(saved, mapping_options(config)).estimate()
        except Exception as error:  # of another version or with other settings: the records are still worth a page
            figures.append(("map", f"saved, but it does not fit this program and these settings: {error}"))
        else:
            figures.append(("known", f"{estimate.grid.known_area_m2():.1f} m²"))
            poses: dict[str, SE2] = {robot: estimate.T_map_robot}
            pictures.append((f"{robot}'s own map, and where it stood last", png(map_picture(estimate.grid.cropped(4), poses))))
    return RobotReport(robot, records, figures, pictures)


def span(first: str, last: str) -> str:
    """Two ISO times as a person writes them: the day once when it is the same."""
    first, last = (time.replace("T", " ").removesuffix("+0000") for time in (first, last))
    day, _, clock = last.partition(" ")
    return f"{first} to {clock if clock and first.startswith(day) else last}"


def read_records(path: Path) -> Iterator[dict[str, Any]]:
    """One object a line; a line that was cut by a crash is passed over."""
    try:
        with path.open("rb") as lines:
            for line in iter(lambda: lines.readline(MAX_LINE_BYTES), b""):
                try:
                    record = json.loads(line)
                except (ValueError, RecursionError):
                    continue
                if isinstance(record, dict):
                    yield record
    except OSError:
        return
