"""Where simulated devices are plugged in: a real pty for another program, or a port inside this process.

PtyServer     serves any number of `ByteDevice`s, each on a pseudo-terminal behind a stable link
SimPort       the same device as a `Port`, for `sim:office?seed=3` and `log:run.clf`
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import pty
import select
import struct
import threading
import time
import tty
from collections.abc import Iterable
from pathlib import Path

from hw.device import register_scheme
from hw.driver import Driver
from hw.errors import DeviceConfigError
from hw.ld06 import Ld06
from hw.sick_lms import SickLms
from hw.sim.catalogue import BASES, LIDARS
from hw.sim.devices import ByteDevice, SickScanner
from hw.sim.faults import FaultyDevice, garbled
from hw.sim.robot import SimulatedRobot
from hw.sim.sight import Sight
from hw.sim.world import open_world
from hw.supervisor import Device
from hw.urls import DeviceUrl
from hw.wheel_driver import WheelDriver
from hw.wheels import WheelBoard

TICK_S = 0.01  # how often bytes move; a 230400 baud line carries 230 bytes in that time
TCGETS2 = 0x802C542A
TERMIOS2 = struct.Struct("=4IB19sII")  # flags, line discipline, control characters, input and output rate
REPLAY_V_MAX_MPS = 100.0  # a recording is driven faster than any robot


class PtyLine:
    """One device on one pseudo-terminal behind a link whose name stays the same.

    The line has a rate: a client that opens it at another one hears garbage and is not understood, unless the device's
    `baud` is 0, as on USB.
    """

    def __init__(self, device: ByteDevice, link: Path) -> None:
        self.device, self.link = device, link
        self._master = -1
        self._is_open = False  # by a client, at the last look
        self._poll = select.poll()
        self.plug()

    @property
    def heard(self) -> list[int]:
        """What to wait on for a client's words; nothing while there is no client."""
        return [self._master] if self._is_open and self._master >= 0 else []

    def plug(self) -> None:
        """The port appears, under whatever name the system gives it."""
        if self.link.exists() and not self.link.is_symlink():
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(self.link))
        self._master, slave = pty.openpty()
        tty.setraw(slave)  # a fresh pty echoes: device bytes would come back as commands
        os.set_blocking(self._master, False)
        aside = self.link.with_name(self.link.name + ".new")
        aside.unlink(missing_ok=True)
        aside.symlink_to(os.ttyname(slave))
        aside.replace(self.link)
        os.close(slave)
        self._poll.register(self._master, select.POLLIN)

    def unplug(self) -> None:
        """The port is gone; whoever has it open reads an error."""
        if self._master >= 0:
            self.link.unlink(missing_ok=True)
            self._poll.unregister(self._master)
            os.close(self._master)
            self._master = -1

    def pump(self, now_s: float) -> None:
        """Move what is due in both directions; while nobody has the port open, the device talks to the air."""
        faulty = self.device if isinstance(self.device, FaultyDevice) else None
        if faulty and faulty.is_absent(now_s):
            self.unplug()
            self.device.emit(now_s)
            return
        if self._master < 0:
            self.plug()
        events = dict(self._poll.poll(0)).get(self._master, 0)
        is_open = self._is_open = not events & select.POLLHUP
        is_right_rate = not is_open or self.device.baud in (0, client_baud(self._master))
        if events & select.POLLIN:
            with contextlib.suppress(OSError):
                data = os.read(self._master, 4096)
                self.device.receive(data if is_right_rate else garbled(data), now_s)
        out = self.device.emit(now_s)
        if out and (is_open or (faulty and faulty.keeps_talking)):
            with contextlib.suppress(OSError):  # a full line loses bytes, as a serial line does
                os.write(self._master, out if is_right_rate else garbled(out))

    def close(self) -> None:
        """Unplug for good."""
        self.unplug()


def client_baud(master: int) -> int:
    """The rate at which the other side has opened a pty; termios2 also tells the odd ones."""
    answer = fcntl.ioctl(master, TCGETS2, bytes(TERMIOS2.size))
    return int(TERMIOS2.unpack(answer)[-1])


class PtyServer:
    """A thread that keeps lines moving.  Use it in a `with`."""

    def __init__(self, lines: Iterable[tuple[ByteDevice, Path]], name: str = "simulated devices", tick_s: float = TICK_S) -> None:
        self._tick_s = tick_s
        self._lines = [PtyLine(device, link) for device, link in lines]
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def __enter__(self) -> PtyServer:
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._stop.set()
        self._thread.join()
        for line in self._lines:
            line.close()

    def _run(self) -> None:
        while not self._stop.is_set():
            self._wait()
            for line in self._lines:
                line.pump(time.monotonic())

    def _wait(self) -> None:
        """For a tick, or until a client says something."""
        heard = [fd for line in self._lines for fd in line.heard]
        if heard:
            select.select(heard, [], [], self._tick_s)
        else:
            self._stop.wait(self._tick_s)


class SimPort:
    """A `Port` that is a simulated device."""

    def __init__(self, device: ByteDevice) -> None:
        self._device = device
        self._woken = threading.Event()

    def read(self, timeout_s: float) -> bytes:
        """See `Port.read`."""
        end_s = time.monotonic() + timeout_s
        while not (data := self._device.emit(time.monotonic())) and time.monotonic() < end_s:
            if self._woken.wait(TICK_S / 2):
                self._woken.clear()
                break
        return data

    def write(self, data: bytes) -> None:
        """See `Port.write`."""
        self._device.receive(data, time.monotonic())

    def set_baud(self, baud: int) -> None:
        """Any rate will do."""

    def set_lines(self, dtr: bool | None, rts: bool | None) -> None:
        """There are no lines."""

    def flush_input(self) -> None:
        """Throw away what was sent before."""
        self._device.emit(time.monotonic())

    def wake(self) -> None:
        """See `Port.wake`."""
        self._woken.set()

    def close(self) -> None:
        """Nothing to give back."""


_shared: dict[str, SimulatedRobot] = {}  # a LIDAR and a wheel board with the same URL sit on the same robot
_sharing = threading.Lock()


def _open_simulated(url: DeviceUrl, kind: str) -> Device:
    """`sim:office?seed=3&start=1`: the world, its seed, and which of its starts."""
    url.only(("seed", "start"))
    seed, start = url.integer("seed", 0), url.integer("start", 0, most=63)
    with _sharing:
        if url.text not in _shared:
            world = open_world(url.path if "seed" not in url.options else f"{url.path}?seed={seed}")
            robot = SimulatedRobot(world, world.start_poses(start + 1, seed)[start], 64 * seed + start)
            robot.begin()
            _shared[url.text] = robot
        robot = _shared[url.text]
    if kind == "lidar":
        return _device(url, Ld06(), LIDARS["ld06"][0](Sight(robot, seed=seed)))
    return _device(url, WheelDriver(WheelBoard(), "simulated wheels"), BASES["wt1"].make(robot))


def _device(url: DeviceUrl, driver: Driver, simulated: ByteDevice) -> Device:
    return Device(url.text, driver, lambda baud, dtr: SimPort(simulated), url.text)


def replay_device(url: DeviceUrl, kind: str, scanner: SickScanner, board: ByteDevice) -> Device:
    """The LIDAR or the wheels of a recording, as a device inside this process."""
    if kind == "lidar":
        return _device(url, SickLms(SickScanner.baud), scanner)
    if kind == "wheels":
        return _device(url, WheelDriver(WheelBoard(None, REPLAY_V_MAX_MPS), "recorded wheels"), board)
    raise DeviceConfigError(f"{url.text}: a recording has a lidar and wheels, no {kind}")


register_scheme("sim", _open_simulated)
