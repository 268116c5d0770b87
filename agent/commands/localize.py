"""`mapquilt localize [LOCAL.yaml] GIVEN.yaml`: where does a small map lie in a big one, and where is the robot in it?

The kidnapped robot's question.  The small map is a file, or what the running robot has drawn since it woke up.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from agent.commands.files import loaded_map, spare_inputs, written_file
from agent.commands.merge_files import LoadedMap, Merged, xyt
from agent.commands.merge_output import pair_picture
from agent.exits import NEGATIVE, OK, PEER, CommandError
from agent.features.snapshot import MapSnapshot
from agent.merging.arrays import without_canvas
from agent.merging.localization import localize
from agent.merging.result import MatchOptions, MergeResult
from agent.running import ask_robot, robot_socket
from agent.view.render import png
from protocol.geometry import SE2

WITHOUT_ANSWER = {"found": False, "status": "error", "x": None, "y": None, "theta": None, "reason": "error"}

EXAMPLES = """\
  mapquilt localize room.yaml building.yaml           room.yaml's frame in building.yaml's; exit code 0: found, 1: not
  mapquilt localize room.yaml building.yaml --json    the same as one JSON object
  mapquilt localize building.yaml                     the robot that runs here: where is it in the building?
  mapquilt localize room.yaml building.yaml -o where.png
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "local", type=Path, nargs="?", metavar="LOCAL.yaml", help="the small map (default: the running robot's own)"
    )
    parser.add_argument("given", type=Path, metavar="GIVEN.yaml", help="the big map")
    parser.add_argument("--robot", metavar="ID", help="which robot, when several run here")
    parser.add_argument("--json", action="store_true", help="one JSON object")
    parser.add_argument("-o", "--output", type=Path, metavar="FILE.png", help="draw both maps and what matched")


def run(args: argparse.Namespace) -> int:
    if args.output is not None:
        spare_inputs([args.output], [path for path in (args.local, args.given) if path is not None])
    given = loaded_map(args.given)
    if args.local is not None:
        local, T_local_robot, name = loaded_map(args.local), None, args.local.name
    else:
        local, T_local_robot, name = running_map(args.robot)
    result = localize(MapSnapshot.of(without_canvas(local)), MapSnapshot.of(without_canvas(given)))
    if args.output is not None:
        picture = _picture(LoadedMap(str(args.given), given), LoadedMap(name, local), result)
        written_file(args.output, picture)
        if not args.quiet:
            print(f"wrote {args.output}", file=sys.stderr)
    answer = as_json(result, T_local_robot)
    print(json.dumps(answer, allow_nan=False) if args.json else as_text(answer, args.given.name, name))
    return OK if result.accepted else NEGATIVE


def running_map(robot: str | None) -> tuple[Any, SE2 | None, str]:
    """The own map of the running robot, its pose in it, and its name."""
    from agent.runtime.packed_maps import unpacked_map  # noqa: PLC0415  only this path needs the runtime

    name, socket = robot_socket(robot)
    status = ask_robot(socket, "status")["status"]
    if name not in status["maps"]:
        raise CommandError(f"{name} has no map yet; drive it a little and ask again", PEER)
    grid = unpacked_map(ask_robot(socket, "map", name=name)["map"])
    pose = status["poses"].get(name)
    return grid, None if pose is None else SE2(*pose), name


def as_json(result: MergeResult, T_local_robot: SE2 | None) -> dict[str, Any]:
    """Everything in the given map's frame, metres and radians; `robot` when the small map is a running robot's."""
    T = result.T_ours_theirs
    answer: dict[str, Any] = {
        "found": result.accepted,
        "status": str(result.status),
        "reason": result.reason,
        **xyt(T),
        "covariance": np.round(result.covariance, 10).tolist() if T is not None else None,
        "match_factor": round(result.factor.value, 5),
        "overlap_m2": round(result.overlap_m2, 3),
        "score": round(result.score, 3),
        "runner_up_score": round(result.runner_up_score, 3),
        "alternatives": [{**xyt(a.T_ours_theirs), "score": round(a.score, 3)} for a in result.alternatives],
    }
    if T is not None and T_local_robot is not None:
        answer["robot"] = xyt(T @ T_local_robot)
    return answer


def as_text(answer: dict[str, Any], given: str, local: str) -> str:
    numbers = f"match factor {answer['match_factor']:.3f}, {answer['overlap_m2']:.1f} m2 in common, score {answer['score']:.1f}"
    numbers += f" (next best {answer['runner_up_score']:.1f})"
    if not answer["found"]:
        return f"not found: {local} in {given}: {answer['reason']} ({numbers})"
    lines = [f"found: {local} lies in {given} at {_place(answer)} ({numbers})"]
    if "robot" in answer:
        lines.append(f"the robot is at {_place(answer['robot'])}")
    return "\n".join(lines)


def _place(pose: dict[str, Any]) -> str:
    return f"x {pose['x']:.3f} m, y {pose['y']:.3f} m, {np.degrees(pose['theta']):.2f} deg"


def _picture(given: LoadedMap, local: LoadedMap, result: MergeResult) -> bytes:
    """The sheet of `mapquilt merge`, for one pair; it counts from the lower-left corners."""
    T = result.T_ours_theirs
    T_corners = None if T is None else given.grid.origin.inverse() @ T @ local.grid.origin
    placed = MergeResult(
        result.status, T_corners, result.covariance, result.factor, result.overlap_m2, result.score, reason=result.reason
    )
    return png(pair_picture(Merged([given, local], MatchOptions(), {(0, 1): placed}, {0: SE2.identity()}), (0, 1)))
