"""A simulated device that misbehaves by a schedule: the bad cable, the brown-out, the loose plug, on command and repeatable.

    drop@5:20,flip@7,stall@10:2,unplug@15:3,storm=0.5         KIND@SECONDS[:VALUE], or KIND=RATE, separated by commas

Seconds count from the moment the device is served.  What a kind means, and its value, stands in `KINDS`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from hw.errors import DeviceConfigError
from hw.sim.devices import ByteDevice

KINDS: dict[str, tuple[float, str]] = {  # kind: (usual value, what it does)
    "drop": (1, "so many bytes are lost"),
    "flip": (1, "so many bytes have one bit turned"),
    "dup": (1, "so many bytes come twice"),
    "insert": (1, "so many random bytes come between"),
    "badsum": (1, "the last bytes of what is sent are wrong"),
    "half": (1, "half of what is sent, then silence for so many seconds"),
    "stall": (1, "silence for so many seconds"),
    "noise": (1, "random bytes instead of the device's for so many seconds"),
    "wrong-baud": (1, "bytes as heard at another rate for so many seconds"),
    "banner": (1, "a boot banner comes between"),
    "unplug": (1, "the port is gone for so many seconds, then comes back under another name behind the same link"),
    "stale": (1, "what is sent while nobody listens is kept for the next client, from then on"),
    "health": (1, "the device reports a protection stop"),
    "reboot": (1, "the device restarts"),
    "booting": (2, "a Hokuyo refuses to scan for so many seconds"),
    "shift": (0.5, "so many turns of a scan are missing; negative: come again"),
    "clock": (1, "the device's clock jumps by so many seconds"),
    "encoder-reset": (1, "the wheel counters restart at zero"),
    "encoder-jump": (5000, "the left wheel counter jumps by so many ticks"),
}
RATES = {"drop-share": "share of bytes lost", "flip-share": "share of bytes with a turned bit", "storm": "random faults a second"}
STORM = ("drop", "flip", "dup", "insert", "badsum", "half", "stall", "noise", "banner", "shift")
BANNER = b"\r\nboot: brown-out, restarting\r\n"
SIGNED = ("shift", "clock", "encoder-jump")  # these may go backwards
MOST = 1e9  # seconds, bytes or ticks
_BYTES = ("drop", "flip", "dup", "insert", "badsum", "banner", "half")
_SPANS = ("stall", "noise", "wrong-baud", "unplug", "half")


@dataclass(frozen=True, slots=True)
class Fault:
    """One entry of a schedule."""

    kind: str
    at_s: float
    value: float


@dataclass(frozen=True, slots=True)
class Schedule:
    """All that will go wrong."""

    faults: tuple[Fault, ...] = ()  # in order of time
    drop_share: float = 0.0
    flip_share: float = 0.0
    storm_hz: float = 0.0

    @staticmethod
    def parse(text: str) -> Schedule:
        """Read a schedule; an error says which entry cannot be, and what there is."""
        faults, rates = [], dict.fromkeys(RATES, 0.0)
        for entry in filter(None, (part.strip() for part in text.split(","))):
            if "=" in entry:
                name, _, number = entry.partition("=")
                if name not in RATES:
                    raise DeviceConfigError(f"fault '{entry}': no such rate; there are {', '.join(RATES)}")
                rates[name] = _number(number, entry, 0, 1000 if name == "storm" else 1)
                continue
            kind, at, rest = entry.partition("@")
            if not at or kind not in KINDS:
                raise DeviceConfigError(f"fault '{entry}': write KIND@SECONDS[:VALUE]; kinds are {', '.join(KINDS)}")
            seconds, _, value = rest.partition(":")
            least = -MOST if kind in SIGNED else 0
            faults.append(
                Fault(kind, _number(seconds, entry, 0, MOST), _number(value, entry, least, MOST) if value else KINDS[kind][0])
            )
        ordered = tuple(sorted(faults, key=lambda fault: fault.at_s))
        return Schedule(ordered, rates["drop-share"], rates["flip-share"], rates["storm"])


def _number(text: str, entry: str, least: float, most: float) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not least <= value <= most:
        raise DeviceConfigError(f"fault '{entry}': '{text}' is no number from {least:g} to {most:g}")
    return value


class FaultyDevice:
    """A `ByteDevice` with a schedule; the same seed gives the same damage for the same bytes."""

    def __init__(self, device: ByteDevice, schedule: Schedule, seed: int = 0) -> None:
        self._device, self._schedule = device, schedule
        self._rng = np.random.default_rng([41, seed])
        self._pending = list(schedule.faults)
        self._until_s = dict.fromkeys(_SPANS, -math.inf)
        self._begun_s: float | None = None
        self._head = b""  # of a frame that breaks off in the middle
        self._next_storm_s = math.inf
        self.done: list[Fault] = []
        self.keeps_talking = False  # also while nobody listens

    @property
    def baud(self) -> int:
        """The wrapped device's."""
        return self._device.baud

    def is_absent(self, now_s: float) -> bool:
        """Is the plug out?"""
        return now_s < self._until_s["unplug"]

    def inject(self, kind: str, value: float | None = None) -> None:
        """A fault that is due now; for tests that wait for something first."""
        self._pending.insert(0, Fault(kind, -math.inf, KINDS[kind][0] if value is None else value))

    def relieve(self) -> None:
        """What lasts, ends now: silence, an empty socket, noise."""
        self._until_s = dict.fromkeys(_SPANS, -math.inf)

    def wear(self, flip_share: float) -> None:
        """From now on this share of the bytes has a turned bit."""
        self._schedule = replace(self._schedule, flip_share=flip_share)

    def receive(self, data: bytes, now_s: float) -> None:
        """See `ByteDevice`."""
        if now_s >= self._until_s["wrong-baud"]:
            self._device.receive(data, now_s)

    def emit(self, now_s: float) -> bytes:
        """See `ByteDevice`: what the device sends, and what becomes of it on the way."""
        data = bytearray(self._device.emit(now_s))
        for fault in self._due(now_s, len(data) > 0):
            self._strike(fault, data, now_s)
        head, self._head = self._head, b""
        if now_s < max(self._until_s[kind] for kind in ("stall", "unplug", "half")):
            return head
        if now_s < self._until_s["noise"]:
            return self._random(len(data))
        if now_s < self._until_s["wrong-baud"]:
            return garbled(bytes(data))
        return self._worn(bytes(data))

    def _due(self, now_s: float, has_data: bool) -> list[Fault]:
        """Faults whose time has come; those that damage bytes wait for some."""
        if self._begun_s is None:
            self._begun_s = now_s
            self._next_storm_s = now_s + self._pause_s()
        elapsed_s = now_s - self._begun_s
        due = [f for f in self._pending if f.at_s <= elapsed_s and (has_data or f.kind not in _BYTES)]
        self._pending = [f for f in self._pending if f not in due]
        if now_s >= self._next_storm_s and has_data:
            self._next_storm_s = now_s + self._pause_s()
            kind = STORM[int(self._rng.integers(len(STORM)))]
            due.append(Fault(kind, elapsed_s, self._storm_value(kind)))
        return due

    def _pause_s(self) -> float:
        rate_hz = self._schedule.storm_hz
        return float(self._rng.exponential(1 / rate_hz)) if rate_hz > 0 else math.inf

    def _storm_value(self, kind: str) -> float:
        if kind == "shift":
            return float(self._rng.uniform(-0.5, 0.5))
        return float(self._rng.uniform(0.01, 0.2)) if kind in _SPANS else float(self._rng.integers(1, 8))

    def _strike(self, fault: Fault, data: bytearray, now_s: float) -> None:
        self.done.append(fault)
        if fault.kind == "half":
            self._head = bytes(data[: len(data) // 2])
            self._until_s["half"] = now_s + fault.value
        elif fault.kind in _SPANS:
            self._until_s[fault.kind] = now_s + fault.value
        elif fault.kind == "stale":
            self.keeps_talking = True
        elif fault.kind in _BYTES:
            self._damage(fault, data)
        elif (misbehave := getattr(self._device, "fault", None)) is not None:
            misbehave(fault.kind, fault.value, now_s)

    def _damage(self, fault: Fault, data: bytearray) -> None:
        n = min(max(1, round(fault.value)), len(data))
        at = int(self._rng.integers(0, len(data) - n + 1))
        if fault.kind == "drop":
            del data[at : at + n]
        elif fault.kind == "dup":
            data[at:at] = data[at : at + n]
        elif fault.kind == "insert":
            data[at:at] = self._random(max(1, round(fault.value)))
        elif fault.kind == "banner":
            data[at:at] = BANNER
        else:
            first = len(data) - n if fault.kind == "badsum" else at
            for k in range(first, first + n):
                data[k] ^= 1 << int(self._rng.integers(8))

    def _worn(self, data: bytes) -> bytes:
        """The shares that a bad cable takes all the time."""
        drop, flip = self._schedule.drop_share, self._schedule.flip_share
        if not data or not (drop or flip):
            return data
        values = np.frombuffer(data, np.uint8).copy()
        is_flipped = self._rng.random(len(values)) < flip
        values[is_flipped] ^= (1 << self._rng.integers(0, 8, int(is_flipped.sum()))).astype(np.uint8)
        return values[self._rng.random(len(values)) >= drop].tobytes()

    def _random(self, n: int) -> bytes:
        return self._rng.integers(0, 256, n, dtype=np.uint8).tobytes()


def garbled(data: bytes) -> bytes:
    """Bytes as a receiver at another rate hears them: fewer, and none of them right."""
    return bytes((b ^ 0x5B) | 0x80 for b in data[::2])
