"""A wheel base as a `Driver`: one of the base protocols, and the integration of its ticks to `Odometry`.

URL options: `ticks` (per revolution), `radius` (of a wheel, metres), `track` (between the wheels, metres), `v_max` (of a
wheel, m/s) and `baud`; a known base, or a board that tells its geometry, needs none of them.
"""

from __future__ import annotations

from collections.abc import Callable

from hw.arduino_bridge import ArduinoBridge
from hw.clock import DeviceClock
from hw.create2 import Create2
from hw.driver import Drain, DriverBase, Pause, Reading, Script, Send
from hw.errors import DeviceConfigError
from hw.kobuki import Kobuki
from hw.odometry import BaseProtocol, TickIntegrator, TickSample, WheelGeometry
from hw.roboclaw import RoboClaw
from hw.urls import DeviceUrl
from hw.wheels import WheelBoard

GEOMETRY = ("ticks", "radius", "track")
OPTIONS = (*GEOMETRY, "v_max", "baud")
DEFAULT_V_MAX_MPS = 3.0


class WheelDriver(DriverBase):
    """Ticks to motion."""

    def __init__(self, protocol: BaseProtocol, name: str) -> None:
        super().__init__()
        self._protocol = protocol
        self._integrator = TickIntegrator(protocol.geometry)
        self._clock: DeviceClock | None = None  # of a board that stamps its samples
        self._last_stamp_s = 0.0
        self.bauds = protocol.baud_rates
        self.baud = self.bauds[0]
        self.identity.model = name
        self.period_s = 0.02
        self.gather_s = 0.005
        self.poll_period_s = protocol.poll_period_s or None

    def start(self) -> Script:
        """See `Driver.start`."""
        yield Drain(quiet_s=0.02, max_s=0.1)
        for request in self._protocol.start_requests():
            yield Send(request)
            yield Pause(0.02)

    def stop(self) -> Script:
        """See `Driver.stop`."""
        for request in self._protocol.stop_requests():
            yield Send(request)

    def restart(self) -> None:
        """Motion while the line was down is not known."""
        self._integrator.break_here()
        self._clock = None

    def poll(self) -> bytes:
        """See `Driver.poll`."""
        return self._protocol.poll_request()

    def feed(self, data: bytes, now_s: float) -> list[Reading]:
        """Odometry after each sample in these bytes."""
        self.counters.bytes_in += len(data)
        readings: list[Reading] = []
        for sample in self._protocol.feed(data):
            self._integrator.geometry = self._protocol.geometry
            self.counters.frames += 1
            readings.append(self._integrator.add(sample, self._stamp_s(sample, now_s)))
        told = self._protocol.counters
        self.counters.bad_frames, self.counters.skipped_bytes = told.bad_frames, told.skipped_bytes
        self.counters.resyncs = told.resyncs
        return readings

    def _stamp_s(self, sample: TickSample, now_s: float) -> float:
        """When the sample was taken: by the board's own clock where it has one, else when it came; never before the last one."""
        stamp_s = now_s
        if sample.clock_s is not None and sample.clock_period_s > 0:
            if self._clock is None or sample.is_reset:
                self._clock = DeviceClock(sample.clock_period_s)
            stamp_s = self._clock.to_host(sample.clock_s, now_s)
        self._last_stamp_s = max(stamp_s, self._last_stamp_s)
        return self._last_stamp_s


def geometry_of(url: DeviceUrl) -> WheelGeometry | None:
    """The geometry the URL gives: all of it, or none."""
    given = [key for key in GEOMETRY if key in url.options]
    if not given:
        return None
    if len(given) < len(GEOMETRY):
        missing = ", ".join(key for key in GEOMETRY if key not in given)
        raise DeviceConfigError(f"{url.text}: {missing} missing; give ticks, radius and track together")
    ticks = url.number("ticks", 0, least=1, most=1e7)
    radius_m, track_m = url.number("radius", 0, least=0.001, most=2), url.number("track", 0, least=0.01, most=10)
    return WheelGeometry.of_wheel(ticks, radius_m, track_m, v_max_of(url))


def v_max_of(url: DeviceUrl) -> float:
    """The fastest a wheel can be, m/s."""
    return url.number("v_max", DEFAULT_V_MAX_MPS, least=0.01, most=50)


def _wt1(url: DeviceUrl) -> WheelDriver:
    url.only(OPTIONS)
    return WheelDriver(WheelBoard(geometry_of(url), v_max_of(url)), "WT1 wheel encoders")


def _create2(url: DeviceUrl) -> WheelDriver:
    url.only(OPTIONS)
    return WheelDriver(Create2(geometry_of(url)), "iRobot Create 2")


def _kobuki(url: DeviceUrl) -> WheelDriver:
    url.only(OPTIONS)
    return WheelDriver(Kobuki(geometry_of(url)), "Kobuki")


def _arduino(url: DeviceUrl) -> WheelDriver:
    url.only(OPTIONS)
    return WheelDriver(ArduinoBridge(_needed_geometry(url)), "ros_arduino_bridge")


def _roboclaw(url: DeviceUrl) -> WheelDriver:
    url.only((*OPTIONS, "address"))
    return WheelDriver(RoboClaw(_needed_geometry(url), url.integer("address", 0x80, 0x80, 0x87)), "RoboClaw")


def _needed_geometry(url: DeviceUrl) -> WheelGeometry:
    geometry = geometry_of(url)
    if geometry is None:
        raise DeviceConfigError(f"{url.text}: this board does not know its wheels; add ?ticks=...&radius=...&track=... (metres)")
    return geometry


BASES: dict[str, Callable[[DeviceUrl], WheelDriver]] = {
    "wheels": _wt1,
    "create2": _create2,
    "kobuki": _kobuki,
    "arduino": _arduino,
    "roboclaw": _roboclaw,
}
