"""Hokuyo URG, UBG, UTM: SCIP 2.0, lines of text with a 6-bit sum each (SERIAL.md 4).

    MD0000108001000 LF            the request, echoed
    99b LF                        status: data follows
    timestamp:4 sum LF            milliseconds, 24 bits, wraps after 4 h 39 m
    data:64 sum LF  ...  LF LF    6 bits a character above '0', three characters a distance in mm

A 6-bit sum lets one damaged line in 64 through, so a scan stands only when every one of its lines, their number and their
lengths are right.  Values below DMIN are no distances but say why there is none: invalid.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hw.clock import DeviceClock
from hw.driver import Ask, Drain, DriverBase, Pause, Reading, Script, Send
from hw.errors import DeviceError, DeviceSilent
from hw.framing import ByteWindow
from hw.readings import LaserScan

CLOCK_PERIOD_S = 2**24 / 1e3
BLOCK_BYTES = 64
MOST_MESSAGE_BYTES = 16384  # ME of 1081 steps takes 6.9 kB
BOOT_TRIES = 20  # a UTM refuses to scan for a second or two after power-up
_ECHO = re.compile(rb"(M[DSE]|G[DSE])(\d{4})(\d{4})(\d{2})(?:\d\d{2})?(?:;.{0,16})?$", re.DOTALL)


def line_sum(text: bytes) -> int:
    """The character behind a line: the low 6 bits of the sum of its bytes, above '0'."""
    return (sum(text) & 0x3F) + 0x30


def is_line_good(line: bytes) -> bool:
    """Is the last character the sum of the others?  A `;` before it counts or not: both are met."""
    if len(line) < 2:
        return False
    body = line[:-1]
    return line_sum(body) == line[-1] or (body[-1:] == b";" and line_sum(body[:-1]) == line[-1])


def encode_value(value: int, characters: int) -> bytes:
    """A number as `characters` characters of 6 bits, the highest first."""
    return bytes((value >> 6 * k & 0x3F) + 0x30 for k in range(characters - 1, -1, -1))


def decode_value(text: bytes) -> int:
    """The number in these characters."""
    value = 0
    for character in text:
        value = value << 6 | (character - 0x30 & 0x3F)
    return value


def decode_values(text: bytes, characters: int) -> NDArray[np.int64]:
    """All numbers in a block of characters."""
    sixes = np.frombuffer(text, np.uint8).astype(np.int64).reshape(-1, characters) - 0x30 & 0x3F
    shifts = 6 * np.arange(characters - 1, -1, -1)
    values: NDArray[np.int64] = (sixes << shifts).sum(axis=1)
    return values


def encode_message(echo: bytes, status: bytes = b"00", lines: Sequence[bytes] = ()) -> bytes:
    """An answer of the sensor: the echo, the status, lines with their sums."""
    out = bytearray(echo + b"\n" + status + bytes((line_sum(status),)) + b"\n")
    for line in lines:
        body = line[:-1] if line.endswith(b";") else line  # the vendor's own sums leave the ; out
        out += line + bytes((line_sum(body),)) + b"\n"
    return bytes(out + b"\n")


def encode_scan(echo: bytes, clock_ms: int, distances_mm: Sequence[int], intensities: Sequence[int] | None = None) -> bytes:
    """A scan message: MD and GD (3 characters), MS and GS (2), ME and GE (3 and 3 with intensities)."""
    characters = 2 if echo[1:2] == b"S" else 3
    if intensities is None:
        data = b"".join(encode_value(mm, characters) for mm in distances_mm)
    else:
        data = b"".join(encode_value(mm, 3) + encode_value(i, 3) for mm, i in zip(distances_mm, intensities, strict=True))
    blocks = [data[at : at + BLOCK_BYTES] for at in range(0, len(data), BLOCK_BYTES)]
    return encode_message(echo, b"99" if echo[:1] == b"M" else b"00", [encode_value(clock_ms, 4), *blocks])


@dataclass(frozen=True, slots=True)
class Message:
    """One answer: echo, status and lines without their sums."""

    echo: bytes
    status: bytes
    lines: tuple[bytes, ...] = ()


def decode_message(block: bytes) -> Message | None:
    """The message in these lines (without the empty one that ends it), or None when a sum is wrong."""
    lines = block.split(b"\n")
    if len(lines) < 2 or not 2 <= len(lines[0]) <= 40 or len(lines[1]) != 3 or not is_line_good(lines[1]):
        return None
    if not all(is_line_good(line) for line in lines[2:]):
        return None
    return Message(lines[0], lines[1][:2], tuple(line[:-1] for line in lines[2:]))


@dataclass(frozen=True, slots=True)
class Parameters:
    """What PP answers."""

    model: str = "UTM-30LX"
    range_min_mm: int = 23
    range_max_mm: int = 60000
    steps_per_turn: int = 1440
    first_step: int = 0
    last_step: int = 1080
    front_step: int = 540
    rpm: int = 2400

    def lines(self) -> list[bytes]:
        """As PP sends them."""
        pairs = (
            ("MODL", self.model),
            ("DMIN", self.range_min_mm),
            ("DMAX", self.range_max_mm),
            ("ARES", self.steps_per_turn),
            ("AMIN", self.first_step),
            ("AMAX", self.last_step),
            ("AFRT", self.front_step),
            ("SCAN", self.rpm),
        )
        return [f"{key}:{value};".encode() for key, value in pairs]

    @staticmethod
    def parse(lines: Sequence[bytes]) -> Parameters | None:
        """What the lines say; None when one is missing or cannot be."""
        told = fields_of(lines)
        try:
            found = Parameters(
                told["MODL"], *(int(told[key]) for key in ("DMIN", "DMAX", "ARES", "AMIN", "AMAX", "AFRT", "SCAN"))
            )
        except (KeyError, ValueError):
            return None
        is_sane = 0 < found.steps_per_turn <= 16384 and 0 <= found.first_step < found.last_step <= found.steps_per_turn
        return found if is_sane and 0 < found.rpm < 100000 and 0 <= found.range_min_mm < found.range_max_mm else None


URG_04LX = Parameters("URG-04LX", 20, 5600, 1024, 44, 725, 384, 600)
UTM_30LX = Parameters()


def fields_of(lines: Sequence[bytes]) -> dict[str, str]:
    """`KEY:value;` lines as a dictionary."""
    pairs = (line.decode("ascii", "replace").rstrip(";").partition(":") for line in lines)
    return {key: value for key, colon, value in pairs if colon}


@dataclass(frozen=True, slots=True)
class ScanData:
    """A scan message understood: raw values, below DMIN an error code."""

    first_step: int
    cluster: int
    clock_ms: int
    values: NDArray[np.int64]
    intensities: NDArray[np.int64] | None = None


def scan_of(message: Message) -> ScanData | None:
    """The scan in a message; None when it is another message, or its blocks do not fit its request."""
    match = _ECHO.match(message.echo)
    if match is None or message.status not in (b"99", b"00") or len(message.lines) < 2:
        return None
    first, last, cluster = int(match[2]), int(match[3]), max(1, int(match[4]))
    if last < first or len(message.lines[0]) != 4:
        return None
    n = (last - first) // cluster + 1
    characters = 2 if match[1][1:] == b"S" else 3
    words = 2 if match[1][1:] == b"E" else 1
    data = b"".join(message.lines[1:])
    is_full = all(len(line) == BLOCK_BYTES for line in message.lines[1:-1])
    if not is_full or len(data) != n * characters * words or any(c < 0x30 or c > 0x6F for c in set(data)):
        return None
    values = decode_values(data, characters)
    clock_ms = decode_value(message.lines[0])
    if words == 2:
        return ScanData(first, cluster, clock_ms, values[0::2], values[1::2])
    return ScanData(first, cluster, clock_ms, values)


class Hokuyo(DriverBase):
    """Driver of the family.  `sees_nothing_as_free`: "nothing in range" becomes `inf`, else nothing is known there."""

    def __init__(self, has_intensity: bool = False, sees_nothing_as_free: bool = False) -> None:
        super().__init__()
        self.identity.model = "Hokuyo"
        self.bauds = (115200, 19200, 57600, 500000, 750000)
        self.period_s = 0.1
        self.coverage = 0.0
        self.parameters: Parameters | None = None
        self._limits_m: tuple[float, float] | None = None
        self._has_intensity, self._sees_nothing_as_free = has_intensity, sees_nothing_as_free
        self._window = ByteWindow(self.counters, 4 * MOST_MESSAGE_BYTES)
        self._clock = DeviceClock(CLOCK_PERIOD_S)
        self._answers: dict[bytes, Message] = {}

    @property
    def range_min_m(self) -> float:
        """Nearest range that is believed."""
        return self._limits_m[0] if self._limits_m else (self.parameters or UTM_30LX).range_min_mm / 1e3

    @property
    def range_max_m(self) -> float:
        """Farthest range that is believed."""
        return self._limits_m[1] if self._limits_m else (self.parameters or UTM_30LX).range_max_mm / 1e3

    def limit(self, range_min_m: float, range_max_m: float) -> None:
        """Believe only ranges within these limits."""
        self._limits_m = (range_min_m, range_max_m)

    def restart(self) -> None:
        """See `Driver.restart`."""
        self._window.clear()
        self._answers.clear()
        self._clock.restart()

    def start(self) -> Script:
        """Quiet, SCIP 2.0, who are you, laser on, scan."""
        yield Send(b"QT\n")
        yield Drain()
        yield Send(b"SCIP2.0\n")
        yield Drain()
        self.restart()
        told = yield self._ask(b"PP")
        if told is None:
            raise DeviceSilent("no answer to PP; is it a Hokuyo that speaks SCIP 2.0, and is it powered?")
        self.parameters = Parameters.parse(told.lines)
        if self.parameters is None:
            raise DeviceError(f"its parameters make no sense: {told.lines!r}")
        version = yield self._ask(b"VV")
        if version is not None:
            told_of = fields_of(version.lines)
            self.identity.serial, self.identity.firmware = told_of.get("SERI", ""), told_of.get("FIRM", "")
        self.identity.model = f"Hokuyo {self.parameters.model.split('(')[0].strip()}"
        self.period_s = 60.0 / self.parameters.rpm
        yield from self._laser_on()
        first, last = self.parameters.first_step, self.parameters.last_step
        yield Send(f"{'ME' if self._has_intensity else 'MD'}{first:04d}{last:04d}01000\n".encode())

    def _laser_on(self) -> Script:
        for _ in range(BOOT_TRIES):
            answer = yield self._ask(b"BM")
            if answer is None or answer.status in (b"00", b"02"):
                return
            if answer.status != b"10":
                break
            yield Pause(0.2)  # it is still starting
        status = answer.status.decode("ascii", "replace")
        raise DeviceError(f"the laser does not come on, status {status}; wait for its lamp, then unplug it and plug it in again")

    def stop(self) -> Script:
        """See `Driver.stop`."""
        yield Send(b"QT\n")

    def _ask(self, command: bytes, timeout_s: float = 0.5) -> Ask:
        self._answers.pop(command, None)
        return Ask(command + b"\n", lambda: self._answers.get(command), timeout_s)

    def feed(self, data: bytes, now_s: float) -> list[Reading]:
        """Scans that these bytes complete; answers are kept for the script."""
        self._window.push(data.replace(b"\r\n", b"\n"))
        readings: list[Reading] = []
        while (end := self._window.data.find(b"\n\n")) >= 0:
            block = self._window.take(end + 2)[:-2].lstrip(b"\n")
            message = self._message(block) if block else None
            if message is None:
                continue
            scan = scan_of(message)
            if scan is not None:
                sent_s = (
                    (len(block) + 2 + len(self._window)) * 10.0 / self.baud if self.baud != 115200 else 0.0
                )  # USB does not wait
                readings.append(self._scan(scan, now_s - sent_s))
            else:
                self._answers[message.echo[:2]] = message
        if len(self._window) > MOST_MESSAGE_BYTES:  # no message is that long: what is here cannot be one
            self._window.skip(len(self._window) - MOST_MESSAGE_BYTES)
        return readings

    def _message(self, block: bytes) -> Message | None:
        """The message in a block; when an end was lost and two ran together, the last of them."""
        message = decode_message(block)
        at = len(block)
        while message is None and (at := max(block.rfind(b"\nM", 0, at), block.rfind(b"\nG", 0, at))) >= 0:
            message = decode_message(block[at + 1 :]) if _ECHO.match(block[at + 1 : block.find(b"\n", at + 1)]) else None
        if message is None or (
            message.echo[:2] in (b"MD", b"MS", b"ME") and message.status == b"99" and scan_of(message) is None
        ):
            self.counters.bad_frames += 1
            self.counters.skip(len(block) + 2)
            return None
        self.counters.skip(max(0, at + 1) if at < len(block) else 0)
        self.counters.good()
        return message

    def _scan(self, scan: ScanData, arrived_s: float) -> LaserScan:
        p = self.parameters or (URG_04LX if scan.first_step + len(scan.values) * scan.cluster <= 800 else UTM_30LX)
        steps = scan.first_step + np.arange(len(scan.values)) * scan.cluster
        step_s = 60.0 / p.rpm / p.steps_per_turn
        sent_at_s = self._clock.to_host(scan.clock_ms / 1e3, arrived_s)  # the clock is read as the beam passes step 0
        first_s = sent_at_s - step_s * (p.last_step - scan.first_step)
        metres = np.where(scan.values < p.range_min_mm, np.nan, scan.values / 1e3)
        with np.errstate(invalid="ignore"):
            metres = np.where((metres < self.range_min_m) | (metres > self.range_max_m), np.nan, metres)
        if self._sees_nothing_as_free:
            metres = np.where(scan.values == (1 if p.model.startswith("UTM") else 0), np.inf, metres)
        self.coverage = 1.0
        offsets_s = ((steps - scan.first_step) * step_s).astype(np.float32)
        return LaserScan(
            stamp_s=first_s,
            ranges_m=metres.astype(np.float32),
            angles_rad=((steps - p.front_step) * (2 * np.pi / p.steps_per_turn)).astype(np.float32),
            range_min_m=self.range_min_m,
            range_max_m=self.range_max_m,
            duration_s=float(offsets_s[-1]),
            intensities=None if scan.intensities is None else scan.intensities.astype(np.float32),
            time_offsets_s=offsets_s,
            is_partial=False,
        )
