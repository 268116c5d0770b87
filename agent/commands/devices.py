"""`mapquilt devices`: serial ports by the names that stay, and which sensor answers on each."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Sequence
from dataclasses import asdict

from agent.exits import NEGATIVE, OK, USAGE, CommandError
from hw.device import schemes
from hw.probing import PROBE_URLS, Answer, SerialPortInfo, probe, serial_ports

EXAMPLES = """\
  mapquilt devices                         the ports there are; nothing is sent to them
  mapquilt devices --probe                 ... and who answers on each (a motor may start)
  mapquilt devices --probe /dev/ttyUSB0    only this port
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("port", nargs="*", help="only these ports")
    parser.add_argument("--probe", action="store_true", help="open each port and find out which sensor answers")
    parser.add_argument("--as", dest="schemes", metavar="KIND,...", help=f"probe only for these: {', '.join(PROBE_URLS)}")
    parser.add_argument("--json", action="store_true", help="one JSON array")


def run(args: argparse.Namespace) -> int:
    known = {port.device: port for port in serial_ports()}
    ports = [known.get(name, SerialPortInfo(name)) for name in args.port] or list(known.values())
    if not ports:
        if args.json:
            print("[]")
        print("no serial port; is the adapter plugged in? (`dmesg | tail` tells what the kernel saw)", file=sys.stderr)
        return NEGATIVE
    wanted = tuple(args.schemes.split(",")) if args.schemes else PROBE_URLS
    _check(wanted, [port.device for port in ports])
    found = [(port, _ask(port, wanted) if args.probe else None) for port in ports]
    if args.json:
        print(json.dumps([_as_json(port, answer) for port, answer in found], indent=2))
    else:
        print("\n".join(_as_text(port, answer, args.probe) for port, answer in found))
    return OK if not args.probe or any(answer for _, answer in found) else NEGATIVE


def _check(wanted: Sequence[str], ports: Sequence[str]) -> None:
    """Probing takes long: what cannot be found is said before."""
    known = [*schemes("lidar"), *schemes("wheels")]
    for scheme in wanted:
        if scheme not in known:
            raise CommandError(f"--as {scheme}: no such kind; there are {', '.join(known)}", USAGE)
    for port in ports:
        if "://" not in port and not os.path.exists(port):
            raise CommandError(f"{port}: no such port; `mapquilt devices` lists the ports there are", NEGATIVE)


def _ask(port: SerialPortInfo, wanted: tuple[str, ...]) -> Answer | None:
    print(f"{port.device}: listening ...", file=sys.stderr)
    return probe(port.device, wanted)


def _as_json(port: SerialPortInfo, answer: Answer | None) -> dict[str, object]:
    facts: dict[str, object] = dict(asdict(port))
    if answer is not None:
        health = answer.health
        facts |= {"url": answer.url, "kind": answer.kind, "model": health.model, "serial": health.serial, "baud": health.baud}
    return facts


def _as_text(port: SerialPortInfo, answer: Answer | None, was_probed: bool) -> str:
    lines = [f"{port.device}  {port.description}".rstrip()]
    lines += [f"    stays the same as  {name}" for name in (port.by_id, port.by_path) if name]
    if port.used_by:
        lines.append(f"    in use by {port.used_by}")
    if answer is not None:
        health = answer.health
        name = " ".join(word for word in (health.model, health.serial and f"serial {health.serial}") if word)
        lines.append(f"    {name}, {health.baud} baud: use  --{answer.kind} {answer.usage}")
    elif was_probed:
        lines.append("    nobody we know answers; is the device powered, and the port not in use?")
    return "\n".join(lines)
