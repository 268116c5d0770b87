"""`mapquilt record DEVICE FILE`: the raw bytes of a device with their times; `replay:FILE` plays them as that device."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from agent.arguments import number
from agent.exits import ENVIRONMENT, NEGATIVE, OK, USAGE, CommandError
from hw.device import open_lidar, open_wheels, schemes
from hw.errors import DeviceConfigError
from hw.recorder import Recorder
from hw.supervisor import Device
from hw.urls import parse_url

EXAMPLES = """\
  mapquilt record ld06:/dev/ttyUSB0 lidar.rec               until Ctrl-C
  mapquilt record wheels:/dev/ttyACM0 wheels.rec --seconds 60
  mapquilt run --lidar replay:lidar.rec --wheels replay:wheels.rec
"""

NO_BYTES = ("sim", "log", "replay")  # no serial device speaks there
START_S = 20.0  # a device whose rate must be found, and whose motor must spin up, takes some of it


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("device", metavar="DEVICE", help="for example ld06:/dev/ttyUSB0")
    parser.add_argument("file", metavar="FILE", type=Path)
    parser.add_argument("--seconds", type=number(0), default=0.0, help="stop so long after the first reading (0: Ctrl-C)")


def run(args: argparse.Namespace) -> int:
    try:
        scheme = parse_url(args.device).scheme
        if scheme in NO_BYTES:
            raise DeviceConfigError(f"{args.device}: nothing to record; give a device on a serial port, or one of `mapquilt sim`")
        device = (open_wheels if scheme in schemes("wheels") else open_lidar)(args.device)
        assert isinstance(device, Device), "what has a serial port is one"
        recorder = Recorder(args.file, args.device)
    except DeviceConfigError as error:
        raise CommandError(str(error), USAGE) from error
    with recorder:
        readings = _record(device, recorder, args.seconds)
    print(f"{args.file}: {recorder.bytes_written} bytes, {readings} readings", file=sys.stderr)
    if recorder.failed:
        raise CommandError(f"{args.file}: {recorder.failed}; what was written so far can be replayed", ENVIRONMENT)
    if readings == 0:
        raise CommandError(device.health().last_error or f"{args.device}: no reading came", NEGATIVE)
    return OK


def _record(device: Device, recorder: Recorder, seconds: float) -> int:
    """Let the device run for so long, or until Ctrl-C; how many readings it gave."""
    device.record(recorder)
    end_s = time.monotonic() + (seconds + START_S if seconds else float("inf"))
    has_begun, told = False, ""
    try:
        with device:
            while time.monotonic() < end_s and not recorder.failed:
                has_reading, error = device.read(0.2) is not None, device.health().last_error
                if has_reading and seconds and not has_begun:
                    has_begun, end_s = True, time.monotonic() + seconds
                if not has_reading and error and error != told:
                    print(f"waiting: {error}", file=sys.stderr, flush=True)
                    told = error
    except KeyboardInterrupt:
        pass
    return device.health().readings
