"""`log:run.clf.gz?part=1/2&speed=4`: a CARMEN recording as the LIDAR and the wheels of a robot."""

from __future__ import annotations

import threading
import time

from hw.carmen import Recording, read_recording
from hw.device import register_scheme
from hw.errors import DeviceConfigError
from hw.sim.devices import SickScanner
from hw.sim.replay import Replay, ReplayBoard, ReplayScans
from hw.sim.sim_port import replay_device
from hw.supervisor import Device
from hw.urls import DeviceUrl

SETTLE_S = 2.0  # from opening the first of the two devices until the recording starts, so that the other is up by then

_replays: dict[str, Replay] = {}
_sharing = threading.Lock()


def open_part(path: str, part: str) -> Recording:
    """`part` of a recording, written "1/2"; the whole of it for "1/1"."""
    index, slash, count = part.partition("/")
    if not (slash and index.isdigit() and count.isdigit() and int(count)):
        raise DeviceConfigError(f"{path}: part={part}; write it as 1/2, the first of two")
    recording = read_recording(path)
    if not recording.has_odometry:
        raise DeviceConfigError(f"{path}: no raw odometry in it, so it makes no wheels; try mapquilt map {path}")
    return recording.part(int(index), int(count))


def _open_replay(url: DeviceUrl, kind: str) -> Device:
    url.only(("part", "speed"))
    with _sharing:
        if url.text not in _replays:
            speed = url.number("speed", 1.0, least=0.1, most=50.0)
            _replays[url.text] = Replay(open_part(url.path, url.text_of("part", "1/1")), speed)
            _replays[url.text].begin(time.monotonic() + SETTLE_S)
        replay = _replays[url.text]
    return replay_device(url, kind, SickScanner(ReplayScans(replay)), ReplayBoard(replay))


register_scheme("log", _open_replay)
