"""A simulated RPLIDAR: answers GET_INFO, GET_HEALTH, the configuration protocol and the motor commands, scans in every mode.

Three units stand for three generations: the A1 at 115200 baud with the express mode, the C1 at 460800 with the dense mode and
the S2 at a million baud with 3200 beams a turn.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np

from hw import rplidar_wire as wire
from hw.rplidar_capsules import Dense, Express, Ultra, UltraDense, ultra_offset_deg
from hw.rplidar_nodes import Node
from hw.sim.sight import Floats, Sight, Turntable, joined, solve_angles

TURN_HZ = 10.0
BANNER = "RP LIDAR System.\r\nFirmware Ver {}.{:02d} - rtm, HW Ver {}\r\nModel: {:x}\r\n"  # some hosts count its bytes
BOOT_S = 0.05
CAPSULES = {kind.type: kind for kind in (Express(), Dense(), Ultra(), UltraDense())}


@dataclass(frozen=True, slots=True)
class Mode:
    """One entry of the list of scan modes."""

    name: str
    type: int
    samples_per_s: int


@dataclass(frozen=True, slots=True)
class Unit:
    """One model of the family."""

    info: wire.Info
    baud: int
    range_max_m: float
    modes: tuple[Mode, ...]
    typical: int
    turn_hz: float = TURN_HZ


def _info(model: int, firmware: tuple[int, int], hardware: int) -> wire.Info:
    return wire.Info(model, firmware, hardware, bytes(range(model, model + 16)))


UNITS = {
    "rplidar-a1": Unit(
        _info(0x18, (1, 29), 7),
        115200,
        12.0,
        (
            Mode("Standard", wire.NODE_TYPE, 2000),
            Mode("Express", wire.EXPRESS_TYPE, 4000),
            Mode("Boost", wire.ULTRA_TYPE, 7680),
        ),
        typical=1,
        turn_hz=5.0,
    ),
    "rplidar-c1": Unit(
        _info(0x41, (1, 2), 18),
        460800,
        12.0,
        (Mode("Standard", wire.NODE_TYPE, 5000), Mode("DenseBoost", wire.DENSE_TYPE, 5000)),
        typical=1,
    ),
    "rplidar-s2": Unit(
        _info(0x71, (1, 1), 18),
        1000000,
        30.0,
        (
            Mode("Standard", wire.NODE_TYPE, 8000),
            Mode("DenseBoost", wire.DENSE_TYPE, 32000),
            Mode("UltraDense", wire.ULTRA_DENSE_TYPE, 32000),
        ),
        typical=1,
    ),
}


class RplidarSim:
    """`ByteDevice` of one unit."""

    def __init__(self, model: str, sight: Sight) -> None:
        self.unit, self._sight = UNITS[model], sight
        self.baud = self.unit.baud
        self.health = wire.Health(0)
        self._inbox, self._outbox = bytearray(), bytearray()
        self._mode: Mode | None = None
        self._head: Turntable | None = None
        self._is_first = False
        self._held: tuple[int, list[int]] | None = None  # an ultra capsule waits for the first beam of the next
        self._booted_s = 0.0
        self._is_booting = False
        self._is_turning = True  # a pseudo-terminal has no line that could stop the motor

    def set_lines(self, dtr: bool, rts: bool, now_s: float) -> None:
        """Modem lines of the adapter, where there are any: DTR raised stops the motor."""
        if self._head is not None and self._is_turning == dtr:
            self._head.restart(now_s)
        self._is_turning = not dtr

    def fault(self, kind: str, value: float, now_s: float) -> None:
        """Misbehave: `health` (protection stop until reset), `shift` (turns that are missing or come again), `reboot`."""
        if kind == "health":
            self.health = wire.Health(2, 0x8002)
        elif kind == "reboot":
            self._reboot(now_s)
        elif kind == "shift" and self._head is not None:
            self._head.shift(value)

    def receive(self, data: bytes, now_s: float) -> None:
        """See `ByteDevice`."""
        if now_s < self._booted_s:
            return
        self._inbox += data
        while self._inbox:
            request, used = wire.parse_request(self._inbox)
            if request is None and used == 0:
                del self._inbox[:-512]
                return
            del self._inbox[:used]
            if request is not None:
                self._obey(request, now_s)

    def _obey(self, request: wire.Request, now_s: float) -> None:
        command, payload = request.command, request.payload
        if command in (wire.STOP_CMD, wire.SCAN_CMD, 0x21, wire.EXPRESS_CMD, wire.RESET_CMD):
            self._outbox += self._measured(now_s)  # what was on its way when it was told to stop
            self._mode, self._held = None, None
        if command == wire.RESET_CMD:
            self._reboot(now_s)
        elif command == wire.INFO_CMD:
            self._outbox += wire.answer(wire.INFO_TYPE, self.unit.info.encode())
        elif command == wire.HEALTH_CMD:
            self._outbox += wire.answer(wire.HEALTH_TYPE, self.health.encode())
        elif command == wire.SAMPLERATE_CMD:
            periods_us = (round(1e6 / mode.samples_per_s) for mode in self.unit.modes[:2])  # standard, express
            self._outbox += wire.answer(wire.SAMPLERATE_TYPE, struct.pack("<HH", *periods_us))
        elif command == wire.BOARD_FLAG_CMD:
            self._outbox += wire.answer(wire.BOARD_FLAG_TYPE, struct.pack("<I", 0))
        elif command == wire.GET_CONF_CMD and len(payload) >= 4:
            self._tell(*struct.unpack_from("<IH", payload + b"\0\0"))
        elif command in (wire.SCAN_CMD, 0x21):
            self._scan(self.unit.modes[0], now_s)
        elif command == wire.EXPRESS_CMD and payload:
            # A working mode of 0 is the express mode of units without a list of modes.
            self._scan(self.unit.modes[min(payload[0] or 1, len(self.unit.modes) - 1)], now_s)

    def _reboot(self, now_s: float) -> None:
        self._mode, self.health = None, wire.Health(0)
        self._booted_s, self._is_booting = now_s + BOOT_S, True
        self._inbox.clear()

    def _tell(self, key: int, mode: int) -> None:
        modes = self.unit.modes
        if key in wire.CONF_OF_MODES and mode >= len(modes):
            return
        rpm = round(60 * self.unit.turn_hz)
        value = {
            wire.CONF_SPEED: lambda: struct.pack("<HH", rpm, 660),
            wire.CONF_SLOWEST: lambda: struct.pack("<H", rpm // 2),
            wire.CONF_FASTEST: lambda: struct.pack("<H", 2 * rpm),
            wire.CONF_MODEL_NAME: lambda: self.unit.info.name.encode() + b"\0",
            wire.CONF_MODE_COUNT: lambda: struct.pack("<H", len(modes)),
            wire.CONF_TYPICAL_MODE: lambda: struct.pack("<H", self.unit.typical),
            wire.CONF_SAMPLE_US: lambda: struct.pack("<I", round(256e6 / modes[mode].samples_per_s)),
            wire.CONF_MAX_DISTANCE: lambda: struct.pack("<I", round(256 * self.unit.range_max_m)),
            wire.CONF_ANSWER_TYPE: lambda: bytes((modes[mode].type,)),
            wire.CONF_MODE_NAME: lambda: modes[mode].name.encode() + b"\0",
        }.get(key)
        if value is not None:
            self._outbox += wire.answer(wire.CONF_TYPE, wire.Conf(key, value()).encode())

    def _scan(self, mode: Mode, now_s: float) -> None:
        if self.health.status >= 2:
            return
        beams = round(mode.samples_per_s / self.unit.turn_hz)
        per_frame, length = 1, 5
        if mode.type in CAPSULES:
            per_frame, length = CAPSULES[mode.type].samples, CAPSULES[mode.type].length
            beams = round(beams / per_frame) * per_frame
        self._mode, self._is_first = mode, True
        self._head = Turntable.in_frames(self.unit.turn_hz, beams, per_frame)
        self._head.restart(now_s)
        self._outbox += wire.Descriptor(length, True, mode.type).encode()

    def emit(self, now_s: float) -> bytes:
        """See `ByteDevice`."""
        if self._is_booting and now_s >= self._booted_s:
            self._is_booting = False
            info = self.unit.info
            self._outbox += BANNER.format(*info.firmware, info.hardware, info.model).encode()
        out = bytes(self._outbox)
        self._outbox.clear()
        return out + self._measured(now_s)

    def _measured(self, now_s: float) -> bytes:
        """What the scan has seen since this was last asked."""
        if not self._is_turning or self._mode is None or self._head is None or not (parts := self._head.due(now_s)):
            return b""
        index, times_s, cuts = joined(parts)
        turn_deg = index * 360.0 / self._head.beams_per_turn
        limits_m = (0.05, self.unit.range_max_m)
        if self._mode.type == wire.ULTRA_TYPE:
            mm = solve_angles(self._sight, times_s, turn_deg, lambda d: -ultra_offset_deg(d), limits_m)
        else:
            mm = self._sight.distances_mm(times_s, -np.radians(turn_deg), *limits_m)
        if self._mode.type == wire.NODE_TYPE:
            return self._nodes(index, turn_deg, mm)
        return b"".join(
            self._capsule(round(angles[0] * 64) % 23040, [int(v) for v in values])
            for angles, values in zip(np.split(turn_deg, cuts), np.split(mm, cuts), strict=True)
        )

    def _nodes(self, index: Floats, turn_deg: Floats, mm: Floats) -> bytes:
        q6, q2 = np.rint(turn_deg * 64).astype(int), np.minimum(mm * 4, 65535).astype(int)
        nodes = zip(index.tolist(), q6.tolist(), q2.tolist(), strict=True)
        return b"".join(Node(i == 0, 15 if d else 0, q, d).encode() for i, q, d in nodes)

    def _capsule(self, start_q6: int, mm: list[int]) -> bytes:
        assert self._mode is not None
        kind = CAPSULES[self._mode.type]
        if isinstance(kind, Ultra):
            held, self._held = self._held, (start_q6, mm)
            if held is None:
                return b""
            start_q6, this, following = *held, mm[0]
            is_first, self._is_first = self._is_first, False
            return kind.encode(start_q6, this, following, is_first)
        is_first, self._is_first = self._is_first, False
        if isinstance(kind, Express):
            return kind.encode(start_q6, [min(v, 16383) for v in mm], is_first=is_first)
        return kind.encode(start_q6, [min(v, 65529) for v in mm], is_first=is_first)
