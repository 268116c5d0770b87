"""Simulated scanners that sweep and are talked to: Hokuyo (SCIP 2.0) and SICK LMS291."""

from __future__ import annotations

import math
import re

import numpy as np

from hw import hokuyo, sick_lms
from hw.sim.devices import SickScanner
from hw.sim.sight import Part, Sight, Turntable

_SCAN = re.compile(rb"([MG])([DSE])(\d{4})(\d{4})(\d{2})(?:(\d)(\d{2}))?$")
_REFUSED = b"10"


class HokuyoSim:
    """A URG-04LX or a UTM-30LX on USB: any baud will do."""

    baud = 0

    def __init__(self, parameters: hokuyo.Parameters, sight: Sight) -> None:
        self.parameters, self._sight = parameters, sight
        self._inbox, self._outbox = bytearray(), bytearray()
        sweep = (parameters.first_step, parameters.last_step + 1)
        self._head = Turntable(parameters.rpm / 60.0, parameters.steps_per_turn, [sweep])
        self._echo = b""  # of the running stream
        self._left: int | None = None  # scans still to send; None: for ever
        self._skip = self._skipped = 0
        self._once: list[bytes] = []  # GD requests waiting for the next sweep
        self._is_laser_on = False
        self._is_timing = False
        self._booting_until_s = -math.inf
        self._clock_offset_s = 0.0

    def fault(self, kind: str, value: float, now_s: float) -> None:
        """Misbehave: `booting` for so many seconds, `clock` jumps by so many seconds, `shift` of the head in turns."""
        if kind == "booting":
            self._booting_until_s, self._is_laser_on, self._echo = now_s + value, False, b""
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

    def _say(self, line: bytes, status: bytes = b"00", lines: list[bytes] | None = None) -> None:
        self._outbox += hokuyo.encode_message(line, status, lines or [])

    def _obey(self, line: bytes, now_s: float) -> None:
        command = line.partition(b";")[0]
        if match := _SCAN.match(command):
            self._scan(line, match, now_s)
        elif command == b"PP":
            self._say(line, lines=self.parameters.lines())
        elif command == b"VV":
            told = ("VEND:Hokuyo Automatic Co.,Ltd.", f"PROD:SOKUIKI Sensor {self.parameters.model}", "FIRM:3.3.00")
            self._say(line, lines=[f"{t};".encode() for t in (*told, "PROT:SCIP 2.0", "SERI:H0000001")])
        elif command == b"II":
            laser = "ON" if self._is_laser_on else "OFF"
            state = (f"MODL:{self.parameters.model}", f"LASR:{laser}", f"SCSP:{self.parameters.rpm}", "MESM:Measuring")
            time_ms = hokuyo.encode_value(self._clock_ms(now_s), 4).decode("latin-1")
            self._say(
                line,
                lines=[f"{t};".encode("latin-1") for t in (*state, "SBPS:USB", f"TIME:{time_ms}", "STAT:Sensor works well.")],
            )
        elif command == b"BM":
            self._laser_on(line, now_s)
        elif command in (b"QT", b"RS", b"RT"):
            self._is_laser_on, self._echo = False, b""
            self._say(line)
        elif command in (b"TM0", b"TM1", b"TM2"):
            self._say(line, lines=[hokuyo.encode_value(self._clock_ms(now_s), 4)] if command == b"TM1" else [])
        elif command in (b"SCIP2.0", b"HS0", b"HS1", b"CR00") or command.startswith(b"SS"):
            self._say(line)
        else:
            self._say(line, b"0E")

    def _laser_on(self, line: bytes, now_s: float) -> None:
        if now_s < self._booting_until_s:
            self._say(line, _REFUSED)
            return
        self._say(line, b"02" if self._is_laser_on else b"00")
        self._is_laser_on = True

    def _scan(self, line: bytes, match: re.Match[bytes], now_s: float) -> None:
        first, last = int(match[3]), int(match[4])
        if last > self.parameters.last_step or last < first:
            self._say(line, b"04" if last > self.parameters.last_step else b"05")
        elif now_s < self._booting_until_s:
            self._say(line, _REFUSED)
        elif match[1] == b"G":
            self._once.append(line)
        elif match[6] is not None:
            self._say(line)
            count = int(match[7])
            self._echo, self._left = line, count or None
            self._skip, self._skipped, self._is_laser_on = int(match[6]), 0, True

    def emit(self, now_s: float) -> bytes:
        """See `ByteDevice`."""
        out = bytearray(self._outbox)
        self._outbox.clear()
        for sweep in self._head.due(now_s):
            if self._once and self._is_laser_on:
                out += b"".join(self._message(line, sweep, None) for line in self._once)
                self._once.clear()
            if self._echo and self._is_due():
                out += self._message(self._echo, sweep, self._left)
                if self._left == 0:
                    self._echo = b""
        return bytes(out)

    def _is_due(self) -> bool:
        self._skipped += 1
        if self._skipped <= self._skip:
            return False
        self._skipped = 0
        self._left = None if self._left is None else self._left - 1
        return True

    def _message(self, line: bytes, sweep: Part, left: int | None) -> bytes:
        command, semicolon, tag = line.partition(b";")
        match = _SCAN.match(command)
        assert match is not None
        first, last, cluster = int(match[3]), int(match[4]), max(1, int(match[5]))
        p = self.parameters
        is_asked = (sweep.index >= first) & (sweep.index <= last)
        step, times_s = sweep.index[is_asked], sweep.times_s[is_asked]
        angles_rad = (step - p.front_step).astype(np.float64) * (math.tau / p.steps_per_turn)
        mm = self._sight.distances_mm(times_s, angles_rad, p.range_min_mm / 1e3, p.range_max_mm / 1e3).astype(int)
        n = (last - first) // cluster + 1
        values = [int(v) for v in mm[: n * cluster : cluster]][:n]
        if match[2] == b"S":
            values = [min(v, 4095) for v in values]
        intensities = [1000] * len(values) if match[2] == b"E" else None
        if left is not None and match[1] == b"M":
            command = command[:-2] + b"%02d" % left
        # The sensor's clock is read when its beam passes step 0.
        zero_s = float(sweep.times_s[0]) - p.first_step * 60.0 / p.rpm / p.steps_per_turn
        return hokuyo.encode_scan(command + semicolon + tag, self._clock_ms(zero_s), values, intensities)

    def _clock_ms(self, time_s: float) -> int:
        return int((time_s + self._clock_offset_s) * 1e3) % 2**24


MODELS = {"hokuyo-urg": hokuyo.URG_04LX, "hokuyo-utm": hokuyo.UTM_30LX}


class SickSim(SickScanner):
    """A SICK LMS291 that wakes at 9600 baud, in centimetres or millimetres, 180 or 100 degrees."""

    def __init__(self, sight: Sight) -> None:
        super().__init__(_Nothing())
        self.baud = 9600
        self._sight = sight
        self._field_deg, self._step_deg, self._is_mm = 180.0, 0.5, True
        self._next_s: float | None = None

    def _answer(self, payload: bytes) -> bytes:
        if payload[0] == sick_lms.VARIANT and len(payload) == 5:
            self._field_deg, self._step_deg = float(payload[1]), (payload[3] | payload[4] << 8) / 100.0
        if payload[0] == 0x74:
            return b"\xf4" + self._config() + b"\x10"
        if payload[0] == 0x77 and len(payload) > 7:
            self._is_mm = payload[7] == 1
            return b"\xf7\x01" + payload[1:] + b"\x10"
        return super()._answer(payload)

    def _config(self) -> bytes:
        """The 32 bytes of the configuration; the sixth is the measuring mode, the seventh the unit."""
        return bytes((0, 0, 70, 0, 0, 6 if self._is_mm else 0, 1 if self._is_mm else 0)) + bytes(25)

    def emit(self, now_s: float) -> bytes:
        """See `ByteDevice`: as many scans as the line carries."""
        out = super().emit(now_s)
        if not self._is_sending:
            self._next_s = None
            return out
        n = round(self._field_deg / self._step_deg) + 1
        period_s = max(sick_lms.MIRROR_S / self._step_deg, (10 + 2 * n) * 10.0 / self.baud)
        if self._next_s is None or now_s - self._next_s > 0.5:
            self._next_s = now_s + period_s
        while self._next_s <= now_s:
            out += self._telegram(n, self._next_s - (10 + 2 * n) * 10.0 / self.baud)
            self._next_s += period_s
        return out

    def _telegram(self, n: int, end_s: float) -> bytes:
        duration_s = sick_lms.MIRROR_S / self._step_deg * self._field_deg / 360.0
        angles_rad = np.radians(np.arange(n) * self._step_deg - self._field_deg / 2)
        times_s = np.linspace(end_s - duration_s, end_s, n)
        far_m, nothing, scale = (32.0, 0x7FFF, 1e3) if self._is_mm else (80.0, 0x1FFF, 1e2)
        ranges_m = self._sight.ranges_m(times_s, angles_rad, 0.05, far_m)
        values = np.where(np.isfinite(ranges_m), np.rint(np.where(np.isfinite(ranges_m), ranges_m, 0) * scale), nothing)
        return sick_lms.scan_telegram([int(v) for v in values], self._is_mm)


class _Nothing:
    def scans_until(self, now_s: float) -> list[list[int]]:
        """See `ScanSource`."""
        return []
