"""A simulated Kobuki: all it sends fifty times a second from power-up, and what it answers and obeys (SERIAL.md 7.2)."""

from __future__ import annotations

import math
import struct

from hw import kobuki
from hw.byte_window import ByteWindow, Counters
from hw.sim.bases_sim import Counting, Streaming

HARDWARE, FIRMWARE, UNIQUE_ID = (1, 0, 4), (1, 2, 0), (0x30414B55, 0x4B4F4255, 0x00000001)
FACTORY_GAINS = (0, 100_000, 100, 2_000)  # the factory's own (0), P, I and D in thousandths
SET_GAINS, GET_GAINS = 13, 14  # of the wheels' controller
IDLE_PARTS = (  # sub-payloads of a robot that is far from its dock, with nothing plugged in
    struct.pack("<BB3B", 3, 3, 0, 0, 0),  # docking infra-red
    struct.pack("<BB3H", 5, 6, 1500, 1500, 1500),  # cliff sensors see the floor
    struct.pack("<BB2B", 6, 2, 0, 0),  # currents of the motors
)
GENERAL_INPUT = struct.pack("<BB8H", 16, 16, 0, 4095, 4095, 4095, 4095, 0, 0, 0)
TRACK_M, METRES_PER_TICK = kobuki.GEOMETRY.track_m, kobuki.GEOMETRY.metres_per_tick


class KobukiSim(Streaming):
    """`ByteDevice`."""

    baud = 115200

    def __init__(self, counting: Counting) -> None:
        super().__init__(counting, 0.02)
        self._counters = Counters()
        self._window = ByteWindow(self._counters, 1024)
        self._commands = kobuki.frames()
        self._gains = struct.pack("<B3I", *FACTORY_GAINS)
        self._extra = b""  # sub-payloads that were asked for
        self._sent = 0
        self._last: tuple[float, float] | None = None  # moment and heading of the frame before

    def receive(self, data: bytes, now_s: float) -> None:
        """See `ByteDevice`."""
        self._window.push(data)
        for row in self._commands.take(self._window, self._counters).data:
            for code, body in (kobuki.decode(kobuki.unpadded(row)) or {}).items():
                self._obey(code, body, now_s)

    def _obey(self, code: int, body: bytes, now_s: float) -> None:
        if code == kobuki.BASE_CONTROL and len(body) == 4:
            left_mps, right_mps = wheel_speeds_mps(*struct.unpack("<hh", body))
            self.counting.turn_wheels(left_mps / METRES_PER_TICK, right_mps / METRES_PER_TICK, now_s)
        elif code == kobuki.REQUEST_EXTRA and len(body) == 2:
            flags = body[0]
            self._extra += struct.pack("<BB4B", 10, 4, *reversed(HARDWARE), 0) if flags & 1 else b""
            self._extra += struct.pack("<BB4B", 11, 4, *reversed(FIRMWARE), 0) if flags & 2 else b""
            self._extra += struct.pack("<BB3I", 19, 12, *UNIQUE_ID) if flags & 8 else b""
        elif code == SET_GAINS and len(body) == len(self._gains):
            self._gains = body
        elif code == GET_GAINS:
            self._extra += bytes((21, len(self._gains))) + self._gains

    def emit(self, now_s: float) -> bytes:
        """See `ByteDevice`."""
        return b"".join(self._frame(time_s) for time_s in self.times(now_s))

    def _frame(self, time_s: float) -> bytes:
        left, right = self.counting.at(time_s)
        core = kobuki.Core(int(time_s * 1e3) % 65536, left % 65536, right % 65536)
        dock, cliff, current = IDLE_PARTS
        inertia, gyro = self._turning(time_s, (right - left) * METRES_PER_TICK / TRACK_M)
        extra, self._extra = self._extra, b""
        self._sent += 1
        return kobuki.encode(core.encode() + dock + inertia + cliff + current + gyro + GENERAL_INPUT + extra)

    def _turning(self, time_s: float, heading_rad: float) -> tuple[bytes, bytes]:
        """What the gyroscope makes of it: heading and rate, and two raw samples."""
        before_s, before_rad = self._last or (time_s, heading_rad)
        self._last = time_s, heading_rad
        rate_deg_s = math.degrees(heading_rad - before_rad) / max(time_s - before_s, 1e-3)
        centidegrees = round(math.degrees(heading_rad) * 100 + 18000) % 36000 - 18000
        raw = max(-32768, min(32767, round(rate_deg_s / 0.00875)))
        inertia = struct.pack("<BBhh3B", 4, 7, centidegrees, max(-32768, min(32767, round(rate_deg_s * 100))), 0, 0, 0)
        return inertia, struct.pack("<BBBB6h", 13, 14, self._sent % 256, 6, 0, 0, raw, 0, 0, raw)


def wheel_speeds_mps(speed_mm_s: int, radius_mm: int) -> tuple[float, float]:
    """Left and right, as the maker's driver means its commands: radius 0 is straight, 1 (or -1) is on the spot."""
    if radius_mm == 0:
        return speed_mm_s / 1e3, speed_mm_s / 1e3
    if abs(radius_mm) == 1:
        return -speed_mm_s * radius_mm / 1e3, speed_mm_s * radius_mm / 1e3
    half_mm = 1e3 * TRACK_M / 2
    outer_mps = speed_mm_s / 1e3  # the command tells the speed of the outer wheel
    inner_mps = outer_mps * (abs(radius_mm) - half_mm) / (abs(radius_mm) + half_mm)
    return (inner_mps, outer_mps) if radius_mm > 0 else (outer_mps, inner_mps)
