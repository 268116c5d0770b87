"""`mapquilt status [--json] [--watch]`: what the robots on this machine see, know and merged."""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from agent.exits import OK, USAGE, CommandError
from agent.running import ask_robot, robot_socket, running_robots
from agent.terminal import has_colour, painted, printable

EXAMPLES = """\
  mapquilt status               every robot that runs on this machine
  mapquilt status --json        the same, one JSON object a line and robot
  mapquilt status --watch       again every second, until Ctrl-C
"""

GOOD, BAD = ("running", "alive", "merged", "tracking"), ("quarantined", "lost", "disconnected", "stuck")
Facts = Mapping[str, Any]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--robot", metavar="ID", help="only this robot")
    parser.add_argument("--json", action="store_true", help="one JSON object a line and robot")
    parser.add_argument("--watch", action="store_true", help="again and again, until Ctrl-C")
    parser.add_argument("--interval", type=float, default=1.0, metavar="S", help="seconds between two looks (default: 1)")


def run(args: argparse.Namespace) -> int:
    if not (math.isfinite(args.interval) and args.interval >= 0.1):
        raise CommandError(f"status: --interval {args.interval:g}; take 0.1 s or more", USAGE)
    statuses = _ask_all(args.robot)
    _show(statuses, {}, args)
    while args.watch:
        time.sleep(args.interval)
        before = {status["robot"]: status for status in statuses}
        try:
            statuses = _ask_all(args.robot)
        except CommandError as error:  # it may come back: a service is started again
            print(error, file=sys.stderr)
            continue
        _show(statuses, before, args)
    return OK


def _ask_all(robot: str | None) -> list[Facts]:
    sockets = running_robots().values() if robot is None else []
    return [ask_robot(socket, "status")["status"] for socket in sockets or [robot_socket(robot)[1]]]


def _show(statuses: Sequence[Facts], before: Mapping[str, Facts], args: argparse.Namespace) -> None:
    if args.json:
        print("\n".join(json.dumps(status) for status in statuses), flush=True)
        return
    if args.watch and sys.stdout.isatty():
        print("\x1b[H\x1b[2J", end="")
    colour = has_colour(sys.stdout)
    print("\n\n".join(status_text(status, before.get(status["robot"]), colour=colour) for status in statuses), flush=True)


def status_text(status: Facts, before: Facts | None = None, *, colour: bool = False) -> str:
    """A robot in a few lines; with an earlier status the traffic is a rate."""
    lines = [f"{painted(printable(status['robot']), 'strong', colour=colour)}  up {duration(status['uptime_s'])}"]
    lines += [_line("mapping", _mapping(status["mapping"], colour))]
    lines += [_line(device["name"], _device(device, colour)) for device in status["devices"]]
    lines += [_line("fleet", text) for text in _fleet(status, before)]
    lines += [_line("peer", _peer(peer, _fits_for_s(status, peer["robot"]), colour)) for peer in status["peers"]]
    if status.get("global"):
        lines.append(_line("together", _together(status["global"])))
    if status.get("merge_times"):
        lines.append(_line("merging", _merging(status["merge_times"])))
    lines += [_line("", painted("! " + printable(problem), "warn", colour=colour)) for problem in status["problems"]]
    return "\n".join(lines)


def _line(name: str, text: str) -> str:
    return f"  {name:<9}{text}"


def _mapping(mapping: Facts, colour: bool) -> str:
    if "known_m2" not in mapping:
        return "waiting for the first scan"
    cpu = mapping.get("cpu_ms_per_scan")
    return (
        f"{_state(mapping['status'], colour)}, {mapping['known_m2']:.0f} m2 known, {mapping['scans']} scans"
        f" ({mapping['scans_lost']} lost)" + (f", {cpu:.1f} ms CPU each" if cpu else "")
    )


def _device(device: Facts, colour: bool) -> str:
    points = f", {device['points']} points" if device.get("points") else ""
    model = f"{device['model']}, " if device.get("model") else ""
    return f"{_state(device['state'], colour)} {device['rate_hz']:.1f} Hz{points}, {printable(model + device['url'])}"


def _fleet(status: Facts, before: Facts | None) -> Iterator[str]:
    group, network = status["group"], status["network"]
    together = f"one map with {', '.join(r for r in group if r != status['robot'])}" if group else "alone so far"
    if network["profile"] == "loopback" and not (network["links"] or status["peers"]):
        together += " (profile loopback: it meets only who is dialled with --connect; --profile lan finds others)"
    net = f"{counted(len(network['links']), 'link')}, {network['profile']}, {network['security']}"
    yield f"{printable(status['fleet'])}: {printable(together)}; {net}"
    sent, received = traffic(status)
    if before is None:
        yield f"sent {sent / 1024:.1f} KB, received {received / 1024:.1f} KB"
    else:
        seconds = max(status["uptime_s"] - before["uptime_s"], 0.1)
        sent_before, received_before = traffic(before)
        yield f"sending {(sent - sent_before) / seconds:.0f} B/s, receiving {(received - received_before) / seconds:.0f} B/s"


def traffic(status: Facts) -> tuple[int, int]:
    """Payload bytes out and in since the start: pushed messages, and answers to pulls."""
    network = status["network"]
    return network["sent_bytes"] + network["served_bytes"], network["received_bytes"] + network["pulled_bytes"]


def _fits_for_s(status: Facts, peer: str) -> float | None:
    """Since when the maps of the two fit."""
    ages = [edge.get("age_s") for edge in status["edges"] if {edge["a"], edge["b"]} == {status["robot"], peer}]
    return ages[0] if ages else None


def _peer(peer: Facts, fits_for_s: float | None, colour: bool) -> str:
    factor = f", match factor {peer['match_factor']:.3f}" if peer.get("match_factor") else ""
    tried = f", {counted(peer['attempts'], 'attempt')}" if peer.get("attempts") else ""
    reason = f" ({printable(peer['reason'])})" if peer.get("reason") else ""
    word = "no fit seen yet" if peer["pair"] == "unseen" else peer["pair"]
    pair = _state(word, colour) + (f" for {duration(fits_for_s)}" if fits_for_s is not None else "")
    return f"{printable(peer['robot'])} {_state(peer['state'], colour)} {peer['age_s']:.1f} s ago, {pair}{factor}{tried}{reason}"


def _together(fused: Facts) -> str:
    members = ", ".join(printable(member) for member in fused["members"])
    return f"{fused['known_m2']:.0f} m2 of {members}; {fused['conflicting_cells']} cells conflict and are unknown"


def _merging(took: Facts) -> str:
    return f"{took['p50_s']:.1f} s from hearing a peer to fitting its map" + (
        f" in the middle of {took['peers']}, {took['p90_s']:.1f} s for the slowest tenth" if took["peers"] > 1 else ""
    )


def counted(n: int, noun: str) -> str:
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def _state(word: str, colour: bool) -> str:
    kind = "good" if word.lower() in GOOD else "bad" if word.lower() in BAD else "faint"
    return painted(printable(word), kind, colour=colour)


def duration(seconds: float) -> str:
    """Two units at most: 42 s, 3 min 5 s, 2 h 10 min, 5 d 3 h."""
    total = int(seconds)
    days, hours, minutes = total // 86400, total // 3600 % 24, total // 60 % 60
    if days:
        return f"{days} d {hours} h"
    if hours:
        return f"{hours} h {minutes} min"
    return f"{minutes} min {total % 60} s" if minutes else f"{total} s"
