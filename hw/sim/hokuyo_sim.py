"""A simulated Hokuyo that speaks SCIP 2.0: every scan mode, its states and clock, and the bit rate of its serial line."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

import numpy as np

from hw import scip
from hw.sim.hokuyo_requests import ScanRequest, scan_request, tag_fault
from hw.sim.sight import Floats, Part, Sight, Turntable

MODELS = {"hokuyo-urg": scip.URG_04LX, "hokuyo-utm": scip.UTM_30LX}
_REFUSED = b"10"
BOOT_S = 1.0
_TIME_STATUS = {(b"TM0", True): b"02", (b"TM1", False): b"04", (b"TM2", False): b"03"}  # (command, is the clock being read): no


class HokuyoSim:
    """A URG-04LX or a UTM-30LX.  `baud` 0: on USB, where any will do; else the rate its serial line wakes at."""

    def __init__(self, parameters: scip.Parameters, sight: Sight, baud: int = 0) -> None:
        self.baud = self._first_baud = baud
        self._next_baud = baud  # from the end of the running answer on
        self.parameters, self._sight = parameters, sight
        self._inbox, self._outbox = bytearray(), bytearray()
        sweep = (parameters.first_step, parameters.last_step + 1)
        self._head = Turntable(parameters.rpm / 60.0, parameters.steps_per_turn, [sweep])
        self._stream: ScanRequest | None = None
        self._left: int | None = None  # scans still to send; None: for ever
        self._skipped = 0
        self._begun_s = 0.0
        self._once: list[ScanRequest] = []  # single scans wait for the next sweep
        self._is_laser_on = False
        self._is_timing = False
        self._booting_until_s = self._asked_to_reboot_s = -math.inf
        self._clock_offset_s = 0.0

    def fault(self, kind: str, value: float, now_s: float) -> None:
        """Misbehave: `booting` for so many seconds, `clock` jumps by so many seconds, `shift` of the head in turns."""
        if kind == "booting":
            self._booting_until_s, self._is_laser_on, self._stream = now_s + value, False, None
        elif kind == "clock":
            self._clock_offset_s += value
        elif kind == "shift":
            self._head.shift(value)

    def receive(self, data: bytes, now_s: float) -> None:
        """See `ByteDevice`."""
        self._inbox += data.replace(b"\r", b"\n")
        *lines, tail = bytes(self._inbox[-4096:]).split(b"\n")
        self._inbox[:] = tail
        for line in lines:
            if line:
                self._obey(line, now_s)

    def _say(self, line: bytes, status: bytes = b"00", texts: Sequence[bytes] = (), blocks: Sequence[bytes] = ()) -> None:
        self._outbox += scip.encode_message(line, status, texts, blocks)

    def _obey(self, line: bytes, now_s: float) -> None:
        command = line.partition(b";")[0]
        if fault := tag_fault(line):
            self._say(line, fault)
        elif (request := scan_request(line, self.parameters.last_step)) is not None:
            self._scan(line, request, now_s)
        elif command == b"PP":
            self._say(line, texts=self.parameters.lines())
        elif command == b"VV":
            self._say(line, texts=_version())
        elif command == b"II":
            self._say(line, texts=self._state(now_s))
        elif command == b"BM":
            self._laser_on(line, now_s)
        elif command in (b"QT", b"RS", b"RT"):
            self._is_laser_on, self._stream, self._is_timing = False, None, False
            self._once.clear()
            self._next_baud = self._first_baud if command == b"RS" else self.baud
            self._say(line)
        elif command == b"RB":
            self._reboot(line, now_s)
        elif command in (b"TM0", b"TM1", b"TM2"):
            self._time(line, command, now_s)
        elif command == b"%ST":
            self._say(line, blocks=[b"%03d" % self._status(now_s)])
        elif command.startswith(b"SS"):
            self._set_rate(line, command[2:])
        elif command in (b"SCIP2.0", b"HS0", b"HS1") or re.match(rb"CR\d\d$", command):
            self._say(line)
        else:
            self._say(line, b"0E")

    def _reboot(self, line: bytes, now_s: float) -> None:
        """Said twice within a second it is meant."""
        is_meant = now_s - self._asked_to_reboot_s < 1.0
        self._asked_to_reboot_s = -math.inf if is_meant else now_s
        self._say(line, b"00" if is_meant else b"01")
        if is_meant:
            self.fault("booting", BOOT_S, now_s)
            self._next_baud = self._first_baud

    def _state(self, now_s: float) -> list[bytes]:
        """What II tells."""
        told = {
            "MODL": self.parameters.model,
            "LASR": "ON" if self._is_laser_on else "OFF",
            "SCSP": f"Initial({self.parameters.rpm}[rpm])",
            "MESM": "Measuring by Normal" if self._stream else "IDLE",
            "SBPS": f"{self.baud}[bps]" if self.baud else "USB only",
            "TIME": f"{self._clock_ms(now_s):06X}",
            "STAT": "Stable 000 no error." if self.parameters is scip.UTM_30LX else "Sensor works well.",
        }
        return [f"{key}:{value};".encode() for key, value in told.items()]

    def _status(self, now_s: float) -> int:
        """0 standby, 1 booting, 2 time mode, 3 single scans, 4 a stream."""
        if now_s < self._booting_until_s:
            return 1
        return 2 if self._is_timing else 4 if self._stream else 3 if self._is_laser_on else 0

    def _time(self, line: bytes, command: bytes, now_s: float) -> None:
        refusal = _TIME_STATUS.get((command, self._is_timing))
        if refusal is None:
            self._is_timing = command != b"TM2"
        is_asked = command == b"TM1" and refusal is None
        self._say(line, refusal or b"00", blocks=[scip.encode_value(self._clock_ms(now_s), 4)] if is_asked else [])

    def _set_rate(self, line: bytes, digits: bytes) -> None:
        rate = int(digits) if digits.isdigit() and len(digits) == 6 else 0
        if rate not in scip.RATES:
            self._say(line, b"04" if rate else b"01")
        elif rate == self.baud:
            self._say(line, b"03")
        else:
            self._say(line)
            self._next_baud = rate if self.baud else 0

    def _laser_on(self, line: bytes, now_s: float) -> None:
        if now_s < self._booting_until_s:
            self._say(line, _REFUSED)
            return
        self._say(line, b"02" if self._is_laser_on else b"00")
        self._is_laser_on = True

    def _scan(self, line: bytes, request: ScanRequest | bytes, now_s: float) -> None:
        if isinstance(request, bytes):
            self._say(line, request)
        elif now_s < self._booting_until_s:
            self._say(line, _REFUSED)
        elif request.is_stream:
            self._say(line)
            self._stream, self._left = request, request.count or None
            self._skipped, self._is_laser_on = 0, True
            self._begun_s = now_s  # the sweep that is under way is not sent
        elif self._is_laser_on and not self._stream:
            self._once.append(request)
        else:
            self._say(line, _REFUSED)

    def emit(self, now_s: float) -> bytes:
        """See `ByteDevice`; a new bit rate holds from behind the answer that grants it."""
        out = bytearray(self._outbox)
        self._outbox.clear()
        if not out:
            self.baud = self._next_baud
        for sweep in self._head.due(now_s):
            if self._once and self._is_laser_on:
                out += b"".join(self._message(request, sweep, None) for request in self._once)
                self._once.clear()
            if self._stream and sweep.times_s[0] >= self._begun_s and self._is_due(self._stream.skip):
                out += self._message(self._stream, sweep, self._left)
                if self._left == 0:
                    self._stream = None
        return bytes(out)

    def _is_due(self, skip: int) -> bool:
        self._skipped += 1
        if self._skipped <= skip:
            return False
        self._skipped = 0
        self._left = None if self._left is None else self._left - 1
        return True

    def _message(self, request: ScanRequest, sweep: Part, left: int | None) -> bytes:
        p = self.parameters
        is_asked = (sweep.index >= request.first) & (sweep.index <= request.last)
        step, times_s = sweep.index[is_asked], sweep.times_s[is_asked]
        angles_rad = (step - p.front_step).astype(np.float64) * (math.tau / p.steps_per_turn)
        mm = self._sight.distances_mm(times_s, angles_rad, p.range_min_mm / 1e3, p.range_max_mm / 1e3)
        values = _nearest(mm, request.cluster)
        if request.kind == b"S":
            values = [min(v, 4095) for v in values]
        intensities = [1000] * len(values) if request.kind == b"E" else None
        # The sensor's clock is read when its beam passes step 0.
        zero_s = float(sweep.times_s[0]) - p.first_step * 60.0 / p.rpm / p.steps_per_turn
        return scip.encode_scan(request.echo(left), self._clock_ms(zero_s), values, intensities)

    def _clock_ms(self, time_s: float) -> int:
        return int((time_s + self._clock_offset_s) * 1e3) % 2**24


def _nearest(mm: Floats, cluster: int) -> list[int]:
    """The least distance of each so many neighbouring steps; 0 where all see nothing."""
    seen = np.minimum.reduceat(np.where(mm > 0, mm, np.inf), np.arange(0, len(mm), cluster))
    return [int(v) if v < np.inf else 0 for v in seen]


def _version() -> list[bytes]:
    """What VV tells."""
    told = ("VEND:Hokuyo Automatic Co.,Ltd.", "PROD:SOKUIKI Sensor", "FIRM:3.3.00", "PROT:SCIP 2.0", "SERI:H0000001")
    return [f"{text};".encode() for text in told]
