"""How an RPLIDAR is brought to scan: quiet, who are you, are you well, spin, and the best mode it has (SERIAL.md 1).

A mode with a checksum is preferred: the device's typical one where it can say so, the express mode where it has one, the
standard scan else.
"""

from __future__ import annotations

import struct

from hw import rplidar_wire as wire
from hw.driver import Ask, Drain, Pause, Script, Send, SetLines
from hw.errors import DeviceError, DeviceSilent
from hw.spinning import SpinningLidar

BAUDS = (115200, 460800, 256000, 1000000)
RANGE_MIN_M, RANGE_MAX_M = 0.05, 40.0
SERIES_RANGE_M = {1: 12.0, 2: 18.0, 3: 25.0, 4: 16.0, 5: 16.0, 6: 40.0, 7: 30.0, 8: 40.0}  # data sheets: A1 A2 A3 C1 C2 S1 S2 S3
DEFAULT_PWM, DEFAULT_RPM = 660, 600
MODES = {"standard": wire.NODE_TYPE, "express": wire.EXPRESS_TYPE, "dense": wire.DENSE_TYPE}
MODES |= {"ultra": wire.ULTRA_TYPE, "ultradense": wire.ULTRA_DENSE_TYPE, "hq": wire.HQ_TYPE}


class RplidarStart(SpinningLidar):
    """Questions and answers; the stream is for whoever inherits, and says in `scan_type` what it carries."""

    def __init__(self, mode: str, rpm: int, pwm: int) -> None:
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
        self._is_limited = False

    def limit(self, range_min_m: float, range_max_m: float) -> None:
        """Believe only ranges within these limits, whatever the data sheet says."""
        super().limit(range_min_m, range_max_m)
        self._is_limited = True

    def restart(self) -> None:
        """See `Driver.restart`."""
        super().restart()
        self.scan_type = None

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
            kind = (yield from self._ask_conf(wire.CONF_ANSWER_TYPE, int(self._mode))) if self.info.has_conf else None
            return None if _is_standard(kind) else int(self._mode)
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
            if self._mode == "auto" and _is_standard(kind):
                return None
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


def _is_standard(kind: wire.Conf | None) -> bool:
    """Is this the standard scan?  It has a request of its own: asked for as an express mode, 0 is another one."""
    return kind is not None and kind.value[:1] == bytes((wire.NODE_TYPE,))
