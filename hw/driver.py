"""What every device driver is: bytes in, readings out, and a script of how to start it.

A driver does no I/O and knows no clock.  How a device is woken is a *script*: a generator of steps that
`script_player.py` carries out, so that it reads from top to bottom like the manual:

    def start(self) -> Script:
        yield Send(STOP)
        yield Drain()
        info = yield Ask(GET_INFO, until=lambda: self.info)     # sends, feeds what comes, until it is not None; None: timeout
        if info is None:
            raise DeviceSilent("no answer to GET_INFO")
        yield Send(SCAN)

Everything that arrives while a script runs is fed to the driver (except while draining), so a recording of the raw bytes
replays through `feed` alone.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from typing import Any, Protocol

from hw.byte_window import Counters
from hw.readings import LaserScan, Odometry

Reading = LaserScan | Odometry


@dataclass(frozen=True, slots=True)
class Send:
    """Write these bytes."""

    data: bytes


@dataclass(frozen=True, slots=True)
class Ask:
    """Write these bytes, then feed what comes until `until()` is not None; that value (None after the timeout) is the answer."""

    data: bytes
    until: Callable[[], object]
    timeout_s: float = 0.5


@dataclass(frozen=True, slots=True)
class Drain:
    """Throw away what comes until the line was quiet for `quiet_s`, `max_s` at the longest; the answer: did it get quiet."""

    quiet_s: float = 0.05
    max_s: float = 0.5


@dataclass(frozen=True, slots=True)
class Pause:
    """Wait; what comes meanwhile is fed."""

    seconds: float


@dataclass(frozen=True, slots=True)
class SetLines:
    """Set modem lines; None leaves a line alone.  A port without such lines ignores it."""

    dtr: bool | None = None
    rts: bool | None = None


@dataclass(frozen=True, slots=True)
class SetBaud:
    """Change the line's rate."""

    baud: int


Step = Send | Ask | Drain | Pause | SetLines | SetBaud
Script = Generator[Step, Any, Any]  # a script may hand a value to the one that called it


@dataclass(slots=True)
class Identity:
    """Who answered."""

    model: str = ""
    serial: str = ""
    firmware: str = ""


class Driver(Protocol):
    """One device, understood.  `bauds`: the rates it may speak at, likeliest first."""

    bauds: tuple[int, ...]
    baud: int  # now
    counters: Counters
    identity: Identity
    period_s: float  # usual time from one reading to the next
    gather_s: float  # bytes are fetched in portions of this long: waking for each frame costs more than decoding it
    open_dtr: bool | None  # level of DTR while opening; None: as the system does
    poll_period_s: float | None  # a device that only answers is asked this often with `poll()`

    def start(self) -> Script: ...

    def stop(self) -> Script: ...

    def restart(self) -> None:
        """Forget what was half decoded: the stream begins anew."""

    def set_baud(self, baud: int) -> None:
        """The line's rate, for the time bytes take to arrive."""

    def poll(self) -> bytes: ...

    def feed(self, data: bytes, now_s: float) -> list[Reading]: ...


@dataclass(slots=True)
class DriverBase:
    """The parts most drivers share; a streaming device that needs no command inherits them all."""

    bauds: tuple[int, ...] = (115200,)
    counters: Counters = field(default_factory=Counters)
    identity: Identity = field(default_factory=Identity)
    period_s: float = 0.1
    gather_s: float = 0.02  # at 100 kB/s 2 kB of the kernel's 4
    open_dtr: bool | None = None
    poll_period_s: float | None = None
    baud: int = 115200

    def start(self) -> Script:
        """A device that streams by itself needs nothing."""
        yield from ()

    def stop(self) -> Script:
        """Nor does it need stopping."""
        yield from ()

    def set_baud(self, baud: int) -> None:
        """The line's rate, for the time bytes take to arrive."""
        self.baud = baud

    def poll(self) -> bytes:
        """Nothing to ask."""
        return b""
