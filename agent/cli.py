"""`mapquilt COMMAND ...`: one table of commands, each in a module of its own that is imported only when asked for.

A command module offers `EXAMPLES` (text), `add_arguments(parser)` and `run(args) -> int`.  Data goes to stdout, talk to stderr.
Who asked for `--json` gets JSON whatever happens: a failure is one object with `error` and `exit_code`, beside what the module's
`WITHOUT_ANSWER` promises (`merge`: accepted, x, y, ...).
"""

from __future__ import annotations

import argparse
import difflib
import errno
import importlib
import json
import os
import re
import signal
import sys
import threading
import traceback
from signal import default_int_handler
from types import ModuleType
from typing import Any, NoReturn

from agent import __version__
from agent.endings import Ended, close_stdout, ending_in_order, seen_off
from agent.exits import BUG, ENVIRONMENT, EXIT_CODES, INTERRUPTED, OK, USAGE, CommandError

os.environ.setdefault("OPENCV_LOG_LEVEL", "ERROR")  # a broken picture is told once, by us
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read when NumPy loads: our matrices are small, its idle threads spin

COMMANDS: dict[str, tuple[str, str]] = {  # name: (module, what it does)
    "run": ("agent.commands.run", "be a robot: map, meet the others, merge"),
    "demo": ("agent.commands.demo", "a fleet of simulated robots on this machine, and a page to look at it"),
    "watch": ("agent.commands.watch", "the live page of a fleet, on a laptop"),
    "status": ("agent.commands.status", "what the running robot sees, knows and merged"),
    "pause": ("agent.commands.control", "the running robot stops mapping; its map stays"),
    "resume": ("agent.commands.control", "the running robot goes on mapping"),
    "reset": ("agent.commands.control", "the running robot starts an empty map"),
    "unmerge": ("agent.commands.control", "the running robot takes a merge back"),
    "readmit": ("agent.commands.control", "a robot that was unmerged may merge again"),
    "stop": ("agent.commands.control", "the running robot saves its map and ends"),
    "save": ("agent.commands.control", "the running robot writes its state now"),
    "merge": ("agent.commands.merge", "lay map files over one another: nav2 maps in and out"),
    "map": ("agent.commands.map", "a recording (CARMEN log, rosbag2, MCAP) into a map"),
    "localize": ("agent.commands.localize", "find a small map in a big one"),
    "features": ("agent.commands.features", "the lines, circles, arcs and curves of a map"),
    "export": ("agent.commands.export", "a robot's saved map as nav2, PNG, TUM or MCAP files"),
    "report": ("agent.commands.report", "a run's records as one HTML page"),
    "devices": ("agent.commands.devices", "serial ports, and which sensor answers on each"),
    "scan": ("agent.commands.scan", "live figures of a LIDAR"),
    "record": ("agent.commands.record", "keep a device's raw bytes, to replay later"),
    "sim": ("agent.commands.sim", "serve a simulated sensor on a pty"),
    "doctor": ("agent.commands.doctor", "what is wrong on this machine, and the command that mends it"),
    "config": ("agent.commands.config", "the settings in force, and where each came from"),
    "fleet": ("agent.commands.fleet", "keys and certificates of a fleet"),
    "router": ("agent.commands.router", "a Zenoh router for larger fleets"),
    "completion": ("agent.commands.completion", "TAB completion for bash, zsh and fish, and a man page"),
}

EXAMPLES = """\
  mapquilt demo                                                    three simulated robots, one map
  mapquilt run --lidar rplidar:/dev/ttyUSB0 --wheels wheels:/dev/ttyACM0
  mapquilt merge a.yaml b.yaml -o both                             two nav2 maps into one
  mapquilt map recording.clf -o out                                a CARMEN log into a map
"""
DISK_FULL = (errno.ENOSPC, errno.EDQUOT)
NEGATIVE_NUMBERS = re.compile(
    r"-\.?\d[\d.,eE+-]*$"
)  # of one number argparse knows it; here lists of them begin with a minus, too


def main(argv: list[str] | None = None) -> int:
    """Runs one command; never raises, the return value is the exit code."""
    argv = sys.argv[1:] if argv is None else argv
    try:
        with ending_in_order(), seen_off():
            return _dispatch(argv)
    except Ended as ended:
        return 128 + ended.number
    except CommandError as error:
        return _failed(argv, str(error), error.code)
    except KeyboardInterrupt:
        return INTERRUPTED
    except BrokenPipeError:  # `mapquilt features map.yaml | head`: the reader has seen enough
        close_stdout()
        return OK
    except OSError as error:
        if error.errno not in DISK_FULL:
            return _bug(argv, error)
        close_stdout()
        return _failed(argv, f"{error.strerror}, with the answer only partly written; make room and try again", ENVIRONMENT)
    except Exception as error:
        return _bug(argv, error)


def _bug(argv: list[str], error: Exception) -> int:
    traceback.print_exc()
    return _failed(argv, f"this is a bug of ours ({type(error).__name__}: {error}); please report it with the lines above", BUG)


def _failed(argv: list[str], message: str, code: int) -> int:
    print(f"mapquilt: {message}", file=sys.stderr)
    name = next((word for word in argv if word in COMMANDS), None)
    if name is not None and "--json" in argv:
        promised = getattr(sys.modules.get(COMMANDS[name][0]), "WITHOUT_ANSWER", {})
        print(json.dumps({**promised, "error": message, "exit_code": code}))
    return code


def _dispatch(argv: list[str]) -> int:
    split = next((i for i, word in enumerate(argv) if not word.startswith("-")), len(argv))
    if split == len(argv):
        return _without_command(argv)
    name = argv[split]
    if name == "help":
        return _dispatch([*argv[split + 1 : split + 2], "--help"])
    if name not in COMMANDS:
        near = difflib.get_close_matches(name, COMMANDS, 1)
        hint = f"; did you mean '{near[0]}'?" if near else "; mapquilt --help lists them"
        raise CommandError(f"unknown command '{name}'{hint}", USAGE)
    parser = command_parser(name)
    args = parser.parse_args([*argv[:split], *argv[split + 1 :]])
    if args.no_color:
        os.environ["NO_COLOR"] = "1"
    return int(load_command(name).run(args))


def load_command(name: str) -> ModuleType:
    """The module of a command, imported now.

    Ctrl-C meanwhile ends the process at once: NumPy takes a KeyboardInterrupt in its import for a broken installation.
    """
    is_ours = threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGINT) is default_int_handler
    if is_ours:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        return importlib.import_module(COMMANDS[name][0])
    finally:
        if is_ours:
            signal.signal(signal.SIGINT, default_int_handler)


def command_parser(name: str) -> argparse.ArgumentParser:
    """The complete parser of one command; `args.command` is its name."""
    module, summary = load_command(name), COMMANDS[name][1]
    examples = f"\n\nexamples:\n{module.EXAMPLES.rstrip()}" if module.EXAMPLES else ""
    parser = _parser(f"mapquilt {name}", f"{summary[0].upper()}{summary[1:]}.{examples}")
    parser.set_defaults(command=name)
    module.add_arguments(parser)
    return parser


def top_parser() -> argparse.ArgumentParser:
    """What `mapquilt --help` shows, without importing any command."""
    listed = "\n".join(f"  {name:<11} {summary}" for name, (_, summary) in COMMANDS.items())
    parser = _parser(
        "mapquilt",
        "Robots that explore apart find out by themselves how their maps fit together, and end up with one map.\n\n"
        f"examples:\n{EXAMPLES}\ncommands:\n{listed}\n\nmapquilt COMMAND --help tells more about one of them.",
    )
    parser.usage = "mapquilt COMMAND ..."
    parser.epilog = f"exit codes:\n{EXIT_CODES}"
    parser.add_argument("--version", action="version", version=f"mapquilt {__version__}")
    return parser


def _without_command(argv: list[str]) -> int:
    parser = top_parser()
    parser.parse_args(argv)
    parser.print_help(sys.stderr)
    return USAGE


class _Parser(argparse.ArgumentParser):
    """One that answers a mistake with one sentence, as everything else here does, and takes `--pose -1,2,90` for a value."""

    def __init__(self, *args: Any, **more: Any) -> None:
        super().__init__(*args, **more)
        self._negative_number_matcher = NEGATIVE_NUMBERS

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:
        parsed, unknown = self.parse_known_args(args, namespace)
        if unknown:
            options = [option for option in self._option_string_actions if option.startswith("--")]
            near = difflib.get_close_matches(unknown[0].partition("=")[0], options, 1)
            hint = f"; did you mean '{near[0]}'?" if near else f"; {self.prog} --help lists what there is"
            raise CommandError(f"{self.prog.partition(' ')[2]}: unknown argument '{unknown[0]}'{hint}", USAGE)
        return parsed

    def error(self, message: str) -> NoReturn:
        raise CommandError(f"{self.prog.partition(' ')[2]}: {message}; {self.prog} --help shows examples", USAGE)


def _parser(prog: str, description: str) -> argparse.ArgumentParser:
    parser = _Parser(prog, description=description, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False)
    parser.add_argument("-q", "--quiet", action="store_true", help="say only what went wrong")
    parser.add_argument("-v", "--verbose", action="store_true", help="say more")
    parser.add_argument("--no-color", action="store_true", help="plain text (also: NO_COLOR=1)")
    return parser
