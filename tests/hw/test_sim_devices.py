"""Every simulated device, understood by the driver a robot would use, and right to the millimetre."""

from __future__ import annotations

import math
import select
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from hw.device import open_lidar, open_wheels
from hw.readings import LaserScan, Odometry
from hw.sim.catalogue import BASES, LIDARS, device_url
from hw.sim.obedient import ObedientRobot
from hw.sim.pty_port import PtyLine, PtyServer
from hw.sim.raycast import cast_all
from hw.sim.robot import SimulatedRobot
from hw.sim.sight import Sight
from hw.sim.world import World
from protocol.geometry import SE2
from tests.harness.waiting import first_reading

ROOM = World.parse("0 0 4.1 0\n4.1 0 4.1 3.3\n4.1 3.3 0.6 3.3\n0.6 3.3 0 2.6\n0 2.6 0 0\n2.8 2.0 3.2 2.0\n3.2 2 3 2.3", "room")
POSE = SE2(1.3, 1.1, math.radians(35))
Serve = Callable[..., Path]


@pytest.fixture
def serve(tmp_path: Path) -> Iterator[Serve]:
    servers: list[PtyServer] = []

    def start(device: object, name: str = "port") -> Path:
        servers.append(PtyServer([(device, tmp_path / name)]))  # type: ignore[list-item]
        servers[-1].__enter__()
        return tmp_path / name

    yield start
    for server in servers:
        server.__exit__()


def errors_m(scan: LaserScan, pose: SE2 = POSE, world: World = ROOM) -> np.ndarray:
    """How far each range is from the walls, one by one, beam by beam."""
    is_return = np.isfinite(scan.ranges_m)
    bearings = pose.theta_rad + scan.angles_rad[is_return].astype(float)
    origins = np.tile([pose.x_m, pose.y_m], (len(bearings), 1))
    return np.abs(cast_all(world.segments, origins, bearings, 100.0) - scan.ranges_m[is_return])


@pytest.mark.parametrize("name", LIDARS)
def test_a_driver_measures_the_room_a_simulated_lidar_stands_in(name: str, serve: Serve) -> None:
    make, _ = LIDARS[name]
    path = serve(make(Sight(ObedientRobot(ROOM, POSE), noise_m=0.0)))
    with open_lidar(device_url(name, path)) as device:
        scan = first_reading(device, lambda reading: isinstance(reading, LaserScan) and not reading.is_partial, 15.0)
    assert isinstance(scan, LaserScan)
    errors = errors_m(scan)
    assert len(errors) > 0.9 * len(scan.ranges_m)
    assert np.median(errors) < 0.004
    assert np.percentile(errors, 95) < 0.03  # at the edge of a wall a hundredth of a degree is metres: not the last few


def test_a_mirrored_lidar_does_not_fit_the_room(serve: Serve) -> None:
    path = serve(LIDARS["ld06"][0](Sight(ObedientRobot(ROOM, POSE), noise_m=0.0, is_mirrored=True)))
    with open_lidar(device_url("ld06", path)) as device:
        scan = first_reading(device, lambda reading: isinstance(reading, LaserScan), 5.0)
    assert isinstance(scan, LaserScan)
    assert np.median(errors_m(scan)) > 0.1


@pytest.mark.parametrize("name", BASES)
def test_a_driver_follows_the_wheels_of_a_simulated_base(name: str, serve: Serve) -> None:
    track = Track(
        BASES[name].drive.track_m, BASES[name].drive.ticks_per_revolution / (math.tau * BASES[name].drive.wheel_radius_m)
    )
    path = serve(BASES[name].make(track))
    with open_wheels(device_url(name, path)) as device:
        first = first_reading(device, lambda reading: isinstance(reading, Odometry), 5.0)
        later = first_reading(device, lambda reading: math.hypot(reading.x_m, reading.y_m) > 0.18, 5.0)
    assert isinstance(first, Odometry) and isinstance(later, Odometry)
    way_m = math.hypot(later.x_m, later.y_m)
    assert later.theta_rad == pytest.approx(way_m * track.turn_rad_s / track.speed_mps, abs=0.01), "on its bend"
    assert way_m == pytest.approx(track.speed_mps * (later.stamp_s - first.stamp_s), abs=0.1), "a busy computer stamps late"


class Track:
    """Wheels on a wide left-hand bend."""

    speed_mps, turn_rad_s = 0.3, 0.2

    def __init__(self, track_m: float, ticks_per_m: float) -> None:
        self._half_m, self._ticks_per_m = track_m / 2, ticks_per_m

    def ticks_at(self, time_s: float) -> tuple[int, int]:
        left, right = (self.speed_mps + side * self._half_m * self.turn_rad_s for side in (-1, 1))
        return math.floor(left * time_s * self._ticks_per_m), math.floor(right * time_s * self._ticks_per_m)


def test_a_robot_that_explores_is_measured_as_it_drives(serve: Serve) -> None:
    robot = SimulatedRobot(ROOM, SE2(1.3, 1.1, 0.0), seed=3)
    robot.begin()
    path = serve(LIDARS["ld06"][0](Sight(robot, noise_m=0.0)))
    with open_lidar(device_url("ld06", path)) as device:
        scan = first_reading(device, lambda reading: isinstance(reading, LaserScan) and not reading.is_partial, 5.0)
    assert isinstance(scan, LaserScan)
    assert np.isfinite(scan.ranges_m).mean() > 0.95


def test_a_unit_on_usb_waits_for_a_slow_host_and_a_serial_line_does_not(tmp_path: Path) -> None:
    class Talker:
        """Says so much at once."""

        def __init__(self, baud: int) -> None:
            self.baud, self._said = baud, [bytes(range(256)) * 120]

        def receive(self, data: bytes, now_s: float) -> None:
            """Is deaf."""

        def emit(self, now_s: float) -> bytes:
            return self._said.pop() if self._said else b""

    def heard(baud: int) -> bytes:
        line = PtyLine(Talker(baud), tmp_path / "port")
        with Path(tmp_path / "port").open("rb", buffering=0) as host:
            data = b""
            while True:
                line.pump(0.0)
                if not select.select([host], [], [], 0)[0]:
                    break
                data += host.read(4096)
        line.close()
        return data

    assert heard(0) == bytes(range(256)) * 120
    assert 4096 <= len(heard(38400)) < 256 * 120
