"""How a device is doing: the states it can be in, all that is to say about it, and how that is judged from its counters."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass
from enum import Enum

from hw.byte_window import Counters


class DeviceState(Enum):
    """Where a device stands."""

    DISCONNECTED = "disconnected"
    PROBING = "probing"
    STARTING = "starting"
    RUNNING = "running"
    DEGRADED = "degraded"


@dataclass(frozen=True, slots=True)
class DeviceHealth:
    """All there is to say about a device, for `status`, `doctor` and the log."""

    url: str
    state: DeviceState
    port: str = ""
    baud: int = 0
    model: str = ""
    serial: str = ""
    firmware: str = ""
    uptime_s: float = 0.0  # since the stream last started
    age_s: float = float("inf")  # of the newest reading
    rate_hz: float = 0.0
    points: int = 0  # of the newest scan
    coverage: float = 0.0  # of the newest scan, 0..1
    bytes_per_s: float = 0.0
    readings: int = 0
    bad_frames: int = 0
    skipped_bytes: int = 0
    rejected: int = 0
    resyncs: int = 0
    stalls: int = 0
    reconnects: int = 0
    dropped: int = 0  # readings nobody fetched in time
    last_error: str = ""  # what went wrong last, and what to try


class RateMeter:
    """Bytes a second over the last two seconds."""

    def __init__(self) -> None:
        self._slots: deque[tuple[float, int]] = deque(maxlen=400)
        self._lock = threading.Lock()

    def add(self, now_s: float, n: int) -> None:
        with self._lock:
            self._slots.append((now_s, n))

    def bytes_per_s(self, now_s: float) -> float:
        with self._lock:
            recent = [(s, n) for s, n in self._slots if now_s - s < 2.0]
        if not recent:
            return 0.0
        return sum(n for _, n in recent) / max(0.1, now_s - recent[0][0])


class StreamJudge:
    """RUNNING or DEGRADED: more than 1 % of the frames bad within a second, or a scan with less than 95 % of its circle."""

    def __init__(self, counters: Counters) -> None:
        self._counters = counters
        self._since_s = 0.0
        self._frames = self._bad = 0
        self._bad_share = 0.0

    def state(self, now_s: float, coverage: float) -> DeviceState:
        if now_s - self._since_s > 1.0:
            c = self._counters
            bad, frames = c.bad_frames + c.rejected, c.frames
            new_bad, new_frames = bad - self._bad, frames - self._frames
            self._bad_share = new_bad / max(1, new_bad + new_frames) if self._since_s else 0.0
            self._since_s, self._bad, self._frames = now_s, bad, frames
        is_fine = self._bad_share <= 0.01 and (coverage == 0.0 or coverage >= 0.95)
        return DeviceState.RUNNING if is_fine else DeviceState.DEGRADED

    def error(self, url: str) -> str:
        if self._bad_share <= 0.01:
            return ""
        return f"{url}: {self._bad_share:.0%} of the frames are damaged; a shorter cable, or another power supply?"
