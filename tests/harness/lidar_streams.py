"""Byte streams of every LIDAR protocol that see one known room: for laws, fuzzing, torture and CPU figures.

The sensor stands still in a room of four walls and two boxes.  `truth_m` tells the range in any direction, `Stream.data` is
what the device sends in `Stream.seconds`, a whole number of turns, so that it can be repeated for hours.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hw import ld06, rplidar_hq, rplidar_wire, scip, sick_wire, xv11, ydlidar_wire
from hw.driver import Driver
from hw.hokuyo import Hokuyo
from hw.ld06 import Ld06
from hw.rplidar import Rplidar
from hw.rplidar_capsules import KINDS, ultra_offset_deg
from hw.rplidar_nodes import Node
from hw.sick_lms import SickLms
from hw.xv11 import Xv11
from hw.ydlidar import YdLidar

Floats = NDArray[np.float64]
_BOXES = ((-4.0, -2.5, 5.0, 3.5), (1.5, 0.8, 2.2, 1.6), (-2.6, -1.9, -2.0, -1.2))  # the room, and what stands in it
_TABLE_PER_DEG = 100


def _range_table() -> Floats:
    angle = np.radians(np.arange(360 * _TABLE_PER_DEG) / _TABLE_PER_DEG)
    dx, dy = np.cos(angle), np.sin(angle)
    best = np.full(len(angle), np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        for x0, y0, x1, y1 in _BOXES:
            for x in (x0, x1):
                t = x / dx
                best = np.where((t > 0) & (t * dy >= y0) & (t * dy <= y1) & (t < best), t, best)
            for y in (y0, y1):
                t = y / dy
                best = np.where((t > 0) & (t * dx >= x0) & (t * dx <= x1) & (t < best), t, best)
    return best


_TABLE = _range_table()


def truth_m(angle_rad: Floats) -> Floats:
    """Range in each direction (counter-clockwise, 0 in front)."""
    return _TABLE[np.round(np.degrees(angle_rad) * _TABLE_PER_DEG).astype(np.int64) % len(_TABLE)]


def errors_m(angle_rad: Floats, ranges_m: Floats) -> Floats:
    """Distance of each range from the nearest true range within a twentieth of a degree; nan where none was given."""
    angle, metres = np.asarray(angle_rad, np.float64), np.asarray(ranges_m, np.float64)
    near = [np.abs(metres - truth_m(angle + np.radians(d))) for d in (-0.05, -0.025, 0.0, 0.025, 0.05)]
    return np.minimum.reduce(near)


@dataclass(frozen=True)
class Stream:
    """What a device sends in `seconds`."""

    name: str
    driver: Callable[[], Driver]
    data: bytes
    seconds: float
    prefix: bytes = b""  # sent once, before: a descriptor, or answers
    has_checksum: bool = True

    @property
    def bytes_per_s(self) -> float:
        return len(self.data) / self.seconds


def _mm(turn_deg: Floats, sign: float = -1.0) -> Floats:
    return np.round(1000 * truth_m(np.radians(sign * turn_deg)))


def _ints(values: Floats) -> list[int]:
    return [int(v) for v in values]


def ldrobot(model: str, seconds: float = 2.0, hz: float = 10.0) -> Stream:
    """LD06 and kin, clockwise."""
    rate = ld06.MODELS[model].samples_per_s
    step_cdeg = 36000.0 * hz / rate
    out = []
    for k in range(round(seconds * rate / ld06.BEAMS)):
        start = round(k * ld06.BEAMS * step_cdeg) % 36000
        end = (start + round((ld06.BEAMS - 1) * step_cdeg)) % 36000
        span = (end - start) % 36000
        turn_deg = (start + span * np.arange(ld06.BEAMS) / (ld06.BEAMS - 1)) / 100.0
        clock_ms = int(1000 * (k + 1) * ld06.BEAMS / rate) % 30000
        packet = ld06.Packet(round(360 * hz), start, end, clock_ms, tuple(_ints(_mm(turn_deg))), (200,) * ld06.BEAMS)
        out.append(ld06.encode(packet))
    return Stream(model, lambda: Ld06(model), b"".join(out), seconds)


def rplidar_nodes(seconds: float = 2.0, rate: int = 2000, hz: float = 5.0) -> Stream:
    """The standard scan."""
    out = []
    per_turn = round(rate / hz)
    for k in range(round(seconds * rate)):
        q6 = round(k % per_turn * 23040 / per_turn)
        out.append(Node(k % per_turn == 0, 15, q6, int(4 * _mm(np.array([q6 / 64.0]))[0])).encode())
    prefix = rplidar_wire.Descriptor(5, True, rplidar_wire.NODE_TYPE).encode()
    return Stream("rplidar-0x81", Rplidar, b"".join(out), seconds, prefix, has_checksum=False)


CAPSULES_PER_TURN = {0x82: 25, 0x85: 25, 0x84: 20, 0x86: 50}  # at 10 Hz: 8, 10, 19 and 32 kHz


def rplidar_capsules(kind_type: int, seconds: float = 2.0, hz: float = 10.0) -> Stream:
    """The modes with a checksum."""
    kind = KINDS[kind_type]
    per_turn = CAPSULES_PER_TURN[kind_type]
    starts = [round(k * 23040 / per_turn) for k in range(per_turn)]
    spans = np.diff([*starts, 23040])
    turns = [(start + span * np.arange(kind.samples) / kind.samples) / 64.0 for start, span in zip(starts, spans, strict=True)]
    distances = [_mm(turn) for turn in turns]
    if kind_type == rplidar_wire.ULTRA_TYPE:  # its beams are turned back by an angle that depends on what they see
        for _ in range(3):
            distances = [_mm(turn - ultra_offset_deg(mm)) for turn, mm in zip(turns, distances, strict=True)]
        for turn, mm in zip(turns, distances, strict=True):  # at an edge no distance fits its own angle: nothing is seen there
            mm[np.abs(mm - _mm(turn - ultra_offset_deg(mm))) > 20] = 0
    out = []
    for k in range(per_turn):
        args = (starts[k], _ints(distances[k]))
        out.append(kind.encode(*args, int(distances[(k + 1) % per_turn][0])) if kind_type == 0x84 else kind.encode(*args))
    prefix = rplidar_wire.Descriptor(kind.length, True, kind_type).encode()
    return Stream(f"rplidar-{kind_type:#x}", Rplidar, b"".join(out) * round(seconds * hz), seconds, prefix)


def rplidar_hq_frames(seconds: float = 2.0, rate: int = 9600, hz: float = 10.0) -> Stream:
    """The HQ answers: 96 beams with their own angles."""
    per_turn = round(rate / hz)
    out = []
    for first in range(0, round(seconds * rate), rplidar_hq.BEAMS):
        counts = np.round((first + np.arange(rplidar_hq.BEAMS)) % per_turn * 65536 / per_turn)
        angle_deg = counts * rplidar_hq.DEG_PER_COUNT
        out.append(rplidar_hq.encode(list(angle_deg), list(_mm(angle_deg))))
    prefix = rplidar_wire.Descriptor(rplidar_hq.FRAME_BYTES, True, rplidar_wire.HQ_TYPE).encode()
    return Stream("rplidar-0x83", Rplidar, b"".join(out), seconds, prefix)


def ydlidar_packets(model: str = "g4", sample_bytes: int = 2, seconds: float = 2.0, rate: int = 5000, hz: float = 10.0) -> Stream:
    """Packets of 40 samples, a start packet each turn; angles corrected as the triangle models ask."""
    per_turn = round(rate / hz)
    out = [ydlidar_wire.encode(ydlidar_wire.Packet(True, hz, 0, 0, (0,), (0,) if sample_bytes > 2 else ()), sample_bytes)]
    for first in range(0, per_turn, 40):
        index = np.arange(first, min(first + 40, per_turn))
        q6 = np.round(index * 23040 / per_turn)
        turn_deg = np.linspace(q6[0], q6[-1], len(index)) / 64.0
        mm = _mm(turn_deg)
        for _ in range(6):
            mm = _mm(turn_deg + ydlidar_wire.correction_deg(mm))
        intensities = tuple(_ints(index % 200)) if sample_bytes > 2 else ()
        packet = ydlidar_wire.Packet(False, 0.0, int(q6[0]), int(q6[-1]), tuple(_ints(4 * mm)), intensities)
        out.append(ydlidar_wire.encode(packet, sample_bytes))
    name = f"ydlidar-{sample_bytes}B"
    return Stream(name, lambda: YdLidar(model), b"".join(out) * round(seconds * hz), seconds)


def neato(kind: xv11.Kind, seconds: float = 2.0, hz: float = 5.0) -> Stream:
    """XV-11 counter-clockwise, LDS-01 clockwise."""
    encode = xv11.encode_xv11 if kind is xv11.XV11 else xv11.encode_lds01
    out = []
    for k in range(kind.packets):
        index = np.arange(k * kind.beams, (k + 1) * kind.beams)
        angle_deg = index if kind is xv11.XV11 else 359.0 - index
        mm = tuple(_ints(_mm(angle_deg.astype(np.float64), 1.0)))
        out.append(encode(xv11.Packet(k, 60 * hz, mm, (100,) * kind.beams)))
    return Stream(kind.name, lambda: Xv11(kind), b"".join(out) * round(seconds * hz), seconds)


def hokuyo_scans(parameters: scip.Parameters = scip.UTM_30LX, seconds: float = 2.0) -> Stream:
    """Continuous MD scans."""
    steps = np.arange(parameters.first_step, parameters.last_step + 1)
    mm = _ints(_mm((steps - parameters.front_step) * 360.0 / parameters.steps_per_turn, 1.0))
    echo = f"MD{parameters.first_step:04d}{parameters.last_step:04d}01000".encode()
    n = round(seconds * parameters.rpm / 60)
    out = [scip.encode_scan(echo, round(k * 60000 / parameters.rpm) % 2**24, mm) for k in range(n)]
    prefix = scip.encode_message(b"PP", b"00", parameters.lines())
    return Stream(f"hokuyo-{parameters.model}", Hokuyo, b"".join(out), seconds, prefix)


def sick_scans(values: int = 361, seconds: float = 2.0, baud: int = 38400) -> Stream:
    """Continuous telegrams, as fast as the line carries them."""
    field_deg, step_deg = sick_wire.FIELDS[values]
    mm = _mm(np.arange(values) * step_deg - field_deg / 2, 1.0)
    telegram = sick_wire.scan_telegram(_ints(mm), is_mm=True)
    n = max(2, int(seconds * baud / 10 / len(telegram)))
    return Stream(f"sick-{values}", SickLms, telegram * n, n * len(telegram) * 10 / baud)


STREAMS: dict[str, Callable[..., Stream]] = {
    "ld06": lambda **kw: ldrobot("ld06", **kw),
    "stl27l": lambda **kw: ldrobot("stl27l", **kw),
    "rplidar-0x81": rplidar_nodes,
    "rplidar-0x82": lambda **kw: rplidar_capsules(0x82, **kw),
    "rplidar-0x83": rplidar_hq_frames,
    "rplidar-0x84": lambda **kw: rplidar_capsules(0x84, **kw),
    "rplidar-0x85": lambda **kw: rplidar_capsules(0x85, **kw),
    "rplidar-0x86": lambda **kw: rplidar_capsules(0x86, **kw),
    "ydlidar-2B": lambda **kw: ydlidar_packets(sample_bytes=2, **kw),
    "ydlidar-3B": lambda **kw: ydlidar_packets(sample_bytes=3, **kw),
    "ydlidar-4B": lambda **kw: ydlidar_packets(sample_bytes=4, **kw),
    "xv11": lambda **kw: neato(xv11.XV11, **kw),
    "lds01": lambda **kw: neato(xv11.LDS01, **kw),
    "hokuyo-urg": lambda **kw: hokuyo_scans(scip.URG_04LX, **kw),
    "hokuyo-utm": lambda **kw: hokuyo_scans(scip.UTM_30LX, **kw),
    "sick": sick_scans,
}


def decode(stream: Stream, data: bytes, chunk: int | None = None, driver: Driver | None = None, begin_s: float = 100.0) -> list:
    """All scans a driver makes of these bytes, fed in portions at the stream's own pace."""
    driver = driver or stream.driver()
    driver.set_baud(round(10 * stream.bytes_per_s))  # as if the line were full: what comes in one portion is dated by its place
    size = chunk or max(1, len(data))
    scans = []
    for at in range(0, len(data), size):
        end = min(at + size, len(data))
        scans += driver.feed(data[at:end], begin_s + end / stream.bytes_per_s)
    return scans
