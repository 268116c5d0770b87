"""`mapquilt doctor`: looks at this machine and its settings, and names the one command that mends what is wrong."""

from __future__ import annotations

import argparse
import getpass
import grp
import json
import os
import shlex
import sys
from collections.abc import Iterator

from agent.commands.doctor_checks import CHECKS
from agent.commands.doctor_findings import Finding, Level, Machine
from agent.config import Config
from agent.config_flags import add_config_arguments, load_from
from agent.config_sources import config_file
from agent.exits import NEGATIVE, OK, CommandError
from agent.terminal import has_colour, painted, printable

EXAMPLES = """\
  mapquilt doctor                                       this machine
  mapquilt doctor --config /etc/mapquilt/robot.toml     ... with the settings of its robot
  mapquilt doctor --json                                one object a line
"""

COLOURS = {Level.OK: "good", Level.WARN: "warn", Level.FAIL: "bad"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="one JSON object a line")
    add_config_arguments(parser)


def run(args: argparse.Namespace) -> int:
    findings = list(examined(args))
    for finding in findings:
        if args.json:
            print(
                json.dumps({"level": finding.level.value, "what": finding.what, "finding": finding.finding, "mend": finding.mend})
            )
        elif not (args.quiet and finding.level is Level.OK):
            print(as_text(finding, colour=has_colour(sys.stdout)))
    return NEGATIVE if any(finding.level is Level.FAIL for finding in findings) else OK


def examined(args: argparse.Namespace) -> Iterator[Finding]:
    """Every check's findings; settings that cannot be read are one of them, and the rest is looked at with the defaults."""
    config = Config()
    try:
        loaded = load_from(args)
        config = loaded.config
        yield Finding(Level.OK, "settings", str(loaded.file or "none written: the defaults"))
    except CommandError as error:
        yield Finding(Level.FAIL, "settings", str(error), _mend_of_settings(str(error), args.config))
    machine = Machine(config, os.environ, groups=own_groups(), user=own_name())
    for check in CHECKS:
        yield from check(machine)


def _mend_of_settings(complaint: str, given: str | None) -> str:
    """A complaint begins with where the mistake was made: in a variable, a flag or the file."""
    where = complaint.partition(":")[0]
    if where.startswith("$"):
        return f"unset {where[1:]}"
    if where.startswith("--"):
        return "mapquilt doctor --help"
    file = config_file(given, os.environ)
    editor = "nano" if file is None or os.access(file if file.exists() else file.absolute().parent, os.W_OK) else "sudo nano"
    return f"{editor} {shlex.quote(str(file))}"


def as_text(finding: Finding, *, colour: bool) -> str:
    level = painted(f"{finding.level.value:<4}", COLOURS[finding.level], colour=colour)
    line = f"{level}  {finding.what:<9} {printable(finding.finding)}"
    return f"{line}\n                mend: {printable(finding.mend)}" if finding.mend else line


def own_groups() -> frozenset[str]:
    names = set()
    for number in os.getgroups():
        try:
            names.add(grp.getgrgid(number).gr_name)
        except KeyError:
            continue
    return frozenset(names)


def own_name() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return str(os.getuid())
