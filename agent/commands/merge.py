"""`mapquilt merge a.yaml b.yaml [c.yaml ...] [-o OUT] [--json]`: lay map files over one another.

Numbers on stdout are in nav_msgs terms: a map's frame sits at the lower-left corner of its cell (0, 0), and `x, y, theta` take
b's frame into a's.  `map_frame` holds the same between the frames that the YAML files' origins speak of.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from agent.commands.files import loaded_map, spare_inputs, writable
from agent.commands.merge_files import LoadedMap, Merged, merge_files
from agent.commands.merge_output import base_name, write_merged
from agent.exits import BAD_INPUT, ENVIRONMENT, NEGATIVE, OK, USAGE, CommandError
from agent.merging.errors import FusionError
from agent.merging.result import MatchOptions

METHODS = ("hybrid", "paper", "paper-guarded")

WITHOUT_ANSWER = {  # what --json holds when there is an error instead of a verdict
    "accepted": False,
    "status": "error",
    "reason": "error",
    **dict.fromkeys(("x", "y", "theta", "score", "match_factor")),
}

EXAMPLES = """\
  mapquilt merge a.yaml b.yaml                  do they fit, and how?  exit code 0: yes, 1: no
  mapquilt merge a.yaml b.yaml --json           the same as one JSON object
  mapquilt merge a.yaml b.yaml -o both          ... and write both.pgm, both.yaml and the picture both.png
  mapquilt merge a.yaml b.yaml c.yaml -o all    three maps and more: every pair is tried, loops must close
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("maps", nargs="+", type=Path, metavar="MAP.yaml", help="nav2 map files, two or more")
    parser.add_argument(
        "-o", "--output", type=Path, metavar="OUT", help="write OUT.pgm, OUT.yaml (in the first map's frame) and OUT.png"
    )
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout")
    parser.add_argument(
        "--method", choices=METHODS, default="hybrid", help="paper: Alnounou et al. to the letter (default: hybrid)"
    )
    parser.add_argument(
        "--resolution", type=float, metavar="METRES", help="cell size of the merged map (default: the finest given)"
    )


def run(args: argparse.Namespace) -> int:
    if len(args.maps) < 2:
        raise CommandError(f"merge: one map ({args.maps[0]}); give two or more", USAGE)
    if args.resolution is not None and not 0.001 <= args.resolution <= 10:
        raise CommandError(f"merge: --resolution {args.resolution:g}; cells measure 0.001 to 10 m", USAGE)
    if args.output is not None:
        base = base_name(writable(args.output))
        spare_inputs([base.with_name(base.name + suffix) for suffix in (".yaml", ".pgm", ".png")], args.maps)
    maps = [LoadedMap(str(path), loaded_map(path)) for path in args.maps]
    merged = merge_files(maps, MatchOptions(method=args.method))
    written = _written(merged, args)
    if args.json:
        print(json.dumps(merged.as_json(), allow_nan=False))
    else:
        print(merged.as_text())
    if not args.quiet:
        for path in written:
            print(f"wrote {path}", file=sys.stderr)
    return OK if merged.is_complete else NEGATIVE


def _written(merged: Merged, args: argparse.Namespace) -> list[Path]:
    if args.output is None:
        return []
    try:
        return write_merged(merged, args.output, args.resolution)
    except FusionError as error:
        raise CommandError(f"merge: {error}", BAD_INPUT) from error
    except OSError as error:
        raise CommandError(f"{args.output}: cannot be written ({error.strerror or error})", ENVIRONMENT) from error
