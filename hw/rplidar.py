"""RPLIDAR A, C, S and T series: who it is, how its motor is started, and its scan in whatever mode it has (SERIAL.md 1).

A mode with a checksum is preferred: the device's typical one where it can say so, the express mode where it has one, the
standard scan else.  In the stream of answers a descriptor may come at any time; what follows it is read accordingly.
"""

from __future__ import annotations

import struct

from hw import rplidar_hq, rplidar_nodes
from hw import rplidar_wire as wire
from hw.driver import Ask, Drain, Pause, Reading, Script, Send, SetLines
from hw.errors import DeviceError, DeviceSilent
from hw.framing import Bytes, ByteWindow, FixedFrames
from hw.rplidar_capsule_chain import CapsuleChain
from hw.rplidar_capsules import KINDS, frames_of, start_angles_q6
from hw.rplidar_nodes import NodeFinder
from hw.scan_assembler import WITNESSES, Beams
from hw.spinning import Floats, Ints, SpinningLidar

BAUDS = (115200, 460800, 256000, 1000000)
RANGE_MIN_M, RANGE_MAX_M = 0.05, 40.0
SERIES_RANGE_M = {1: 12.0, 2: 18.0, 3: 25.0, 4: 16.0, 5: 16.0, 6: 40.0, 7: 30.0, 8: 40.0}  # data sheets: A1 A2 A3 C1 C2 S1 S2 S3
DEFAULT_PWM, DEFAULT_RPM = 660, 600
MODES = {"standard": wire.NODE_TYPE, "express": wire.EXPRESS_TYPE, "dense": wire.DENSE_TYPE}
MODES |= {"ultra": wire.ULTRA_TYPE, "ultradense": wire.ULTRA_DENSE_TYPE, "hq": wire.HQ_TYPE}


class Rplidar(SpinningLidar):
    """Driver of the whole family.  `mode`: "auto", one of `MODES`, or a number of the device's own list."""

    def __init__(self, mode: str = "auto", rpm: int = DEFAULT_RPM, pwm: int = DEFAULT_PWM) -> None:
        super().__init__(RANGE_MIN_M, RANGE_MAX_M)
        self.identity.model = "RPLIDAR"
        self.bauds = BAUDS
        self.open_dtr = False  # DTR raised stops the motor of an A1
        self.info: wire.Info | None = None
        self.health: wire.Health | None = None
        self.scan_type: int | None = None  # what the stream carries now
        self._mode, self._rpm, self._pwm = mode, rpm, pwm
        self._conf: wire.Conf | None = None
        self._board_flag: int | None = None
        self._single: wire.Descriptor | None = None
        self._is_limited = False
        self._nodes = NodeFinder()
        self._chain = CapsuleChain(self.counters)
        self._capsules: dict[int, FixedFrames] = {kind: frames_of(KINDS[kind]) for kind in KINDS}
        self._restart_stream()

    def limit(self, range_min_m: float, range_max_m: float) -> None:
        """Believe only ranges within these limits, whatever the data sheet says."""
        super().limit(range_min_m, range_max_m)
        self._is_limited = True

    def restart(self) -> None:
        """See `Driver.restart`."""
        super().restart()
        self.scan_type, self._single = None, None
        self._restart_stream()

    def _restart_stream(self) -> None:
        self._nodes.restart()
        self._chain.restart()
        self._last_angle_q6 = 0

    def start(self) -> Script:
        """Quiet, who are you, are you well, spin, scan."""
        yield from self._silence()
        yield from self._identify()
        yield from self._check_health()
        yield from self._spin_up()
        yield from self._scan()

    def stop(self) -> Script:
        """Silent, and the motor at rest."""
        yield Send(wire.request(wire.STOP_CMD))
        yield Pause(0.01)
        if self.info is not None and self.info.series >= 6:
            yield Send(wire.request(wire.RPM_CMD, b"\0\0"))
        elif self._board_flag:
            yield Send(wire.request(wire.PWM_CMD, b"\0\0"))
        yield SetLines(dtr=True)

    def _silence(self) -> Script:
        yield Send(wire.request(wire.STOP_CMD))
        yield Drain()
        self.restart()

    def _identify(self) -> Script:
        self.info = None
        for _ in range(2):
            if (yield Ask(wire.request(wire.INFO_CMD), lambda: self.info, 0.4)) is not None:
                return
            yield from self._silence()
        raise DeviceSilent(
            f"no answer to GET_INFO at {self.baud} baud; is it an RPLIDAR, is it powered (500 mA), is no other program using it?"
        )

    def _check_health(self) -> Script:
        code = 0
        for attempt in range(2):
            self.health = None
            health = yield Ask(wire.request(wire.HEALTH_CMD), lambda: self.health, 0.4)
            if health is None or health.status < 2:
                return
            code = health.error_code
            if attempt == 0:
                yield Send(wire.request(wire.RESET_CMD))
                yield Pause(1.0)
                yield Drain(quiet_s=0.2, max_s=2.0)
                self.restart()
        raise DeviceError(
            f"the LIDAR reports a protection stop, error {code:#06x}; is the head blocked? unplug it and plug it in again"
        )

    def _spin_up(self) -> Script:
        assert self.info is not None
        yield SetLines(dtr=False)
        if self.info.series >= 6:
            yield Send(wire.request(wire.RPM_CMD, struct.pack("<H", self._rpm)))
            return
        self._board_flag = None
        if (yield Ask(wire.request(wire.BOARD_FLAG_CMD, bytes(4)), lambda: self._board_flag, 0.2)):
            yield Send(wire.request(wire.PWM_CMD, struct.pack("<H", self._pwm)))

    def _scan(self) -> Script:
        """Ask for the best mode; the standard scan is what every one of them can do."""
        mode = yield from self._choose_mode()
        if mode is not None:
            if (yield Ask(wire.express_request(mode), lambda: self.scan_type, 1.0)) is not None:
                return
            yield from self._silence()
        if (yield Ask(wire.request(wire.SCAN_CMD), lambda: self.scan_type, 2.0)) is None:
            raise DeviceSilent("it answered who it is, but will not scan; does the motor turn?")

    def _choose_mode(self) -> Script:
        """The number of the express mode to ask for; None: the standard scan."""
        assert self.info is not None
        if self._mode.isdigit():
            return int(self._mode)
        if self._mode == "standard":
            return None
        if self.info.has_conf:
            return (yield from self._choose_from_list())
        if self._mode not in ("auto", "express"):
            raise DeviceError(f"this RPLIDAR has no list of modes, so no mode '{self._mode}'; use mode=express or mode=standard")
        return 0 if self.info.has_express else None

    def _choose_from_list(self) -> Script:
        if self._mode == "auto":
            typical = yield from self._ask_conf(wire.CONF_TYPICAL_MODE)
            candidates: list[int] = [] if typical is None else [typical.number & 0xFFFF]
        else:
            count = yield from self._ask_conf(wire.CONF_MODE_COUNT)
            candidates = [] if count is None else list(range(min(count.number & 0xFFFF, 16)))
        for mode in candidates:
            kind = yield from self._ask_conf(wire.CONF_ANSWER_TYPE, mode)
            if kind is None or not kind.value:
                continue
            if kind.value[0] == MODES.get(self._mode, kind.value[0]) and kind.value[0] in wire.SCAN_LENGTHS:
                return mode
        if self._mode == "auto":
            return None
        raise DeviceError(f"this {self.identity.model} does not offer the mode '{self._mode}'; use mode=auto")

    def _ask_conf(self, key: int, mode: int | None = None) -> Script:
        self._conf = None
        answer = yield Ask(
            wire.conf_request(key, mode), lambda: self._conf if self._conf and self._conf.key == key else None, 0.3
        )
        return answer

    def feed(self, data: bytes, now_s: float) -> list[Reading]:
        """Scans that these bytes complete; answers are kept for the script."""
        self._arrive(data, now_s)
        readings: list[Reading] = []
        while True:
            if self._single is not None:
                if len(self._window) < self._single.length:
                    break
                self._answered(self._single.type, self._window.take(self._single.length))
                self._single = None
                continue
            at, descriptor = self._next_descriptor()
            if self.scan_type is not None:
                readings += self._feed_stream(at, now_s)
            if descriptor is None:
                break
            if self.scan_type is None:
                self._window.skip(at)
            self._begin(descriptor)
        if self.scan_type is None and self._single is None:
            self._window.skip_to(b"\xa5\x5a")
        return readings

    def _next_descriptor(self) -> tuple[int, wire.Descriptor | None]:
        data = self._window.data
        at = data.find(b"\xa5\x5a")
        while at >= 0:
            descriptor = wire.Descriptor.decode(data[at : at + wire.DESCRIPTOR_BYTES])
            if descriptor is not None:
                return at, descriptor
            at = data.find(b"\xa5\x5a", at + 1)
        return len(data), None

    def _begin(self, descriptor: wire.Descriptor) -> None:
        """A descriptor stands at the front of the window."""
        self._window.take(wire.DESCRIPTOR_BYTES)
        self.counters.gap_bytes = 0
        if descriptor.is_multi:
            self.scan_type = descriptor.type
            self._assembler.witnesses = (
                (1, 3) if descriptor.type in KINDS else WITNESSES
            )  # an XOR lets pairs of equal flips through
            self._restart_stream()
            self._drop_held()
            self._assembler.restart()
        else:
            self.scan_type, self._single = None, descriptor

    def _answered(self, kind: int, body: bytes) -> None:
        if kind == wire.INFO_TYPE and (info := wire.Info.decode(body)):
            self.info = info
            self.identity.model, self.identity.serial = info.name, info.serial.hex().upper()
            if not self._is_limited:
                self._assembler.range_max_m = SERIES_RANGE_M.get(info.series, RANGE_MAX_M)
            self.identity.firmware = f"{info.firmware[0]}.{info.firmware[1]:02d}"
        elif kind == wire.HEALTH_TYPE:
            self.health = wire.Health.decode(body)
        elif kind == wire.CONF_TYPE:
            self._conf = wire.Conf.decode(body)
        elif kind == wire.BOARD_FLAG_TYPE and len(body) >= 4:
            self._board_flag = body[0] & 1

    def _feed_stream(self, n: int, now_s: float) -> list[Reading]:
        """Read the first n bytes of the window as the running scan; a descriptor stands behind them if n is not all."""
        window = self._window
        if n < len(window):
            rest = bytes(window.data[n:])
            del window.data[n:]
            readings = self._take(window, now_s)
            window.clear()
            window.data.extend(rest)
            return readings
        return self._take(window, now_s)

    def _take(self, window: ByteWindow, now_s: float) -> list[Reading]:
        if self.scan_type == wire.NODE_TYPE:
            frames = self._nodes.take(window, self.counters)
            angles_q6 = [row[1] >> 1 | row[2] << 7 for row in frames.data.tolist()]
        elif self.scan_type == wire.HQ_TYPE:
            frames = rplidar_hq.FRAMES.take(window, self.counters)
            return self._hold(frames, now_s, len(frames) > 0)
        elif self.scan_type in self._capsules:
            frames = self._capsules[self.scan_type].take(window, self.counters)
            angles_q6 = (start_angles_q6(KINDS[self.scan_type], frames.data)[0]).tolist()
        else:
            window.skip(len(window))
            return []
        is_turn = False
        for angle_q6 in angles_q6:
            is_turn |= angle_q6 < self._last_angle_q6
            self._last_angle_q6 = angle_q6
        return self._hold(frames, now_s, is_turn)

    def _beams(self, frames: Bytes, gaps: Ints, arrivals_s: Floats) -> Beams:
        byte_s = 10.0 / self.baud
        if self.scan_type == wire.NODE_TYPE:
            return rplidar_nodes.beams(frames, gaps, arrivals_s - rplidar_nodes.NODE_BYTES * byte_s)
        if self.scan_type == wire.HQ_TYPE:
            return rplidar_hq.beams(frames, gaps, arrivals_s - rplidar_hq.FRAME_BYTES * byte_s, self.period_s)
        assert self.scan_type is not None
        return self._chain.beams(KINDS[self.scan_type], frames, gaps, arrivals_s, byte_s, self.period_s)

    def _witnessed(self, data: Bytes, gaps: Ints, arrivals_s: Floats) -> tuple[Bytes, Ints, Floats]:
        """Nodes were chosen by how they follow; capsules are chosen by the one behind them, when they are decoded."""
        return data, gaps, arrivals_s
