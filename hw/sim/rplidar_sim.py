"""A simulated RPLIDAR: answers GET_INFO, GET_HEALTH, the configuration protocol and the motor commands, scans in every mode."""

from __future__ import annotations

import struct

import numpy as np

from hw import rplidar_wire as wire
from hw.rplidar_capsules import Dense, Express, Ultra, UltraDense, ultra_offset_deg
from hw.rplidar_nodes import Node
from hw.sim.rplidar_units import UNITS, Mode
from hw.sim.sight import Floats, Sight, Turntable, joined, solve_angles

BANNER = "RP LIDAR System.\r\nFirmware Ver {}.{:02d} - rtm, HW Ver {}\r\nModel: {:x}\r\n"  # some hosts count its bytes
BOOT_S = 0.05
PATIENCE_S = 1.0  # for the rest of a request that has begun
CAPSULES = {kind.type: kind for kind in (Express(), Dense(), Ultra(), UltraDense())}


class RplidarSim:
    """`ByteDevice` of one unit."""

    def __init__(self, model: str, sight: Sight) -> None:
        self.unit, self._sight = UNITS[model], sight
        self.baud = self.unit.baud
        self.health = wire.Health(0)
        self._inbox, self._outbox = bytearray(), bytearray()
        self._begun_s = 0.0  # the request of which only a part has come
        self._turn_hz = self.unit.turn_hz
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
        if now_s - self._begun_s > PATIENCE_S:
            self._inbox.clear()
        if not self._inbox:
            self._begun_s = now_s
        self._inbox += data
        while self._inbox:
            request, used = wire.parse_request(self._inbox)
            if request is None and used == 0:
                del self._inbox[:-512]
                return
            del self._inbox[:used]
            self._begun_s = now_s
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
            self._outbox += wire.answer(wire.BOARD_FLAG_TYPE, struct.pack("<I", self.unit.has_pwm))
        elif command == wire.GET_CONF_CMD and len(payload) >= 4:
            self._tell(*struct.unpack_from("<IH", payload + b"\0\0"))
        elif command == wire.SET_CONF_CMD and len(payload) >= 4:
            self._outbox += wire.answer(wire.CONF_SET_TYPE, payload[:4] + bytes(4))  # granted, and without effect
        elif command == wire.RPM_CMD and len(payload) == 2:
            self._set_speed(struct.unpack("<H", payload)[0] / 60.0, now_s)
        elif command in (wire.SCAN_CMD, 0x21):
            self._scan(self.unit.modes[0], now_s)
        elif command == wire.EXPRESS_CMD and payload:
            # A working mode of 0 is the express mode of units without a list of modes.
            self._scan(self.unit.modes[min(payload[0] or 1, len(self.unit.modes) - 1)], now_s)

    def _set_speed(self, turn_hz: float, now_s: float) -> None:
        """Turn slower or faster, within half and twice the usual; 0 rests the motor, which the next scan starts again."""
        turn_hz = min(2 * self.unit.turn_hz, max(self.unit.turn_hz / 2, turn_hz)) if turn_hz > 0 else self._turn_hz
        if turn_hz != self._turn_hz:
            self._turn_hz = turn_hz
            if self._mode is not None:
                self._outbox += self._measured(now_s)
                self._is_first, self._held = True, None
                self._begin_turn(self._mode, now_s)

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
        self._mode, self._is_first = mode, True
        self._begin_turn(mode, now_s)
        self._outbox += wire.Descriptor(wire.SCAN_LENGTHS[mode.type], True, mode.type).encode()

    def _begin_turn(self, mode: Mode, now_s: float) -> None:
        beams = round(mode.samples_per_s / self._turn_hz)
        per_frame = CAPSULES[mode.type].samples if mode.type in CAPSULES else 1
        self._head = Turntable.in_frames(self._turn_hz, round(beams / per_frame) * per_frame, per_frame)
        self._head.restart(now_s)

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
        # No real turn begins at 0 to the digit, and the maker's SDK would not see it pass.
        turn_deg = (index + 0.5) * 360.0 / self._head.beams_per_turn
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
