"""A recording becomes devices again: the same scans, the raw motion, never the corrected poses."""

from __future__ import annotations

import gzip
import math
import os
from pathlib import Path

import numpy as np
import pytest

from hw import sick_wire
from hw.carmen import Recording, read_recording
from hw.device import open_lidar, open_wheels
from hw.errors import DeviceConfigError
from hw.odometry import TickIntegrator
from hw.readings import LaserScan, Odometry
from hw.sick_lms import SickLms
from hw.sim.devices import SickScanner
from hw.sim.replay import Replay, ReplayBoard, ReplayScans, phases
from hw.wheels import WheelBoard
from protocol.geometry import SE2

TRUE_STEPS = [SE2(0.4, 0.02, 0.1), SE2(0.5, -0.05, -0.4), SE2(-0.2, 0.0, 0.05), SE2(0.0, 0.0, 1.2), SE2(0.6, 0.2, 0.5)]


def log_text(beams: int = 181) -> str:
    """Each FLASER jumps to a "corrected" pose; the ODOM lines before it carry the raw motion from the one before."""
    lines, corrected = ["# a recording", "PARAM laser_offset 0"], SE2(3.0, 4.0, 0.3)
    for k in range(len(TRUE_STEPS) + 1):
        ranges = " ".join(f"{1 + 0.01 * ((k * 7 + i) % 300):.2f}" if i != 3 else "81.83" for i in range(beams))
        pose = f"{corrected.x_m:.6f} {corrected.y_m:.6f} {corrected.theta_rad:.6f}"
        lines.append(f"FLASER {beams} {ranges} {pose} {pose} {100 + k:.3f} host {k:.3f}")
        if k < len(TRUE_STEPS):
            lines.append(f"ODOM {pose} 0.1 0.0 0.0 {100 + k:.3f} host {k:.3f}")
            raw = corrected @ TRUE_STEPS[k]
            lines.append(f"ODOM {raw.x_m:.6f} {raw.y_m:.6f} {raw.theta_rad:.6f} 0.1 0.0 0.0 {100.9 + k:.3f} host {k + 0.9:.3f}")
            corrected = raw @ SE2(0.05, -0.03, 0.02)  # what the filter made of it
    return "\n".join(lines) + "\n"


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "walk.clf.gz"
    path.write_bytes(gzip.compress(log_text().encode()))
    return path


def close_to(a: SE2, b: SE2, metres: float = 1e-4) -> bool:
    return a.distance_m(b) < metres and abs(math.remainder(a.theta_rad - b.theta_rad, math.tau)) < metres


def test_the_raw_motion_is_rebuilt_and_the_corrections_are_not_in_it(log: Path) -> None:
    scans = read_recording(log).scans
    assert all(scan.motion and close_to(scan.motion, step) for scan, step in zip(scans[1:], TRUE_STEPS, strict=True))
    assert np.isinf(scans[0].ranges_m[3])


@pytest.mark.parametrize(("beams", "step_deg"), [(180, 1.0), (181, 1.0), (360, 0.5), (361, 0.5)])
def test_beams_start_at_the_right_and_lie_a_degree_or_half_a_degree_apart(beams: int, step_deg: float, tmp_path: Path) -> None:
    (tmp_path / "a.clf").write_text(log_text(beams))
    angles = np.degrees(read_recording(tmp_path / "a.clf").scans[0].angles_rad)
    assert angles[0] == pytest.approx(-90)
    assert np.diff(angles) == pytest.approx(step_deg, abs=1e-4)


def test_parts_are_stretches_of_time_and_each_begins_at_its_own_origin(log: Path) -> None:
    whole = read_recording(log)
    first, second = whole.part(1, 2), whole.part(2, 2)
    assert [*first.scans, *second.scans][0] is not None
    assert len(first.scans) + len(second.scans) == len(whole.scans)
    assert second.scans[0].motion == SE2.identity()
    with pytest.raises(DeviceConfigError, match="part 3/2"):
        whole.part(3, 2)


@pytest.mark.parametrize("text", ["", "hello\nworld\n", "FLASER 3 1 2\n", "FLASER 99999 1 2 3\n", "FLASER x\n"])
def test_what_is_no_log_is_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "a.clf").write_text(text)
    with pytest.raises(DeviceConfigError, match=r"a\.clf"):
        read_recording(tmp_path / "a.clf")


@pytest.mark.parametrize("motion", [*TRUE_STEPS, SE2(-1.0, 0.5, 3.0), SE2.identity()])
def test_any_motion_is_a_turn_a_drive_and_a_turn(motion: SE2) -> None:
    from hw.odometry import arc  # noqa: PLC0415

    pose = SE2.identity()
    for _, (left, right) in phases(motion, 1.0):
        pose = pose @ arc(float(left), float(right), 0.3)
    assert close_to(pose, motion, 2e-4)


def replayed(recording: Recording, speed: float) -> tuple[list[LaserScan], list[Odometry]]:
    """Bytes of both devices through their decoders, in steps of ten milliseconds."""
    replay = Replay(recording, speed)
    replay.begin(10.0)
    scanner, board = SickScanner(ReplayScans(replay)), ReplayBoard(replay)
    driver, wheels = SickLms(500000), WheelBoard(None, 100.0)
    driver.set_baud(500000)

    scanner.receive(sick_wire.encode(sick_wire.CONTINUOUS), 10.0)
    scans, track = [], []
    integrator = TickIntegrator(wheels.geometry)
    for k in range(int((replay.duration_s + 0.3) / 0.01)):
        now_s = 10.0 + 0.01 * k
        scans += [reading for reading in driver.feed(scanner.emit(now_s), now_s) if isinstance(reading, LaserScan)]
        for sample in wheels.feed(board.emit(now_s)):
            integrator.geometry = wheels.geometry
            track.append(integrator.add(sample, sample.clock_s or 0.0))
    return scans, track


@pytest.mark.parametrize("speed", [1.0, 8.0])
def test_a_replay_gives_every_scan_and_the_odometry_fits_at_each(log: Path, speed: float) -> None:
    recording = read_recording(log)
    scans, track = replayed(recording, speed)
    assert len(scans) == len(recording.scans)
    times = [odometry.stamp_s for odometry in track]
    poses = []
    for scan, recorded in zip(scans, recording.scans, strict=True):
        is_return = np.isfinite(recorded.ranges_m)
        errors_m = np.abs(scan.ranges_m[is_return] - recorded.ranges_m[is_return])
        assert np.nanmax(errors_m) < 0.006
        assert np.isnan(errors_m).sum() <= 6  # right after the handshake the driver believes no beam that stands alone
        assert not np.isfinite(scan.ranges_m[~is_return]).any()
        at = [np.interp(scan.stamp_s, times, [getattr(o, name) for o in track]) for name in ("x_m", "y_m", "theta_rad")]
        poses.append(SE2(*map(float, at)))
    for before, after, step in zip(poses, poses[1:], TRUE_STEPS, strict=False):
        assert close_to(before.inverse() @ after, step, 2e-3)


def test_a_log_is_a_device_url(log: Path) -> None:
    url = f"log:{log}?part=1/2&speed=8"
    with open_lidar(url) as lidar, open_wheels(url) as wheels:
        seen: set[type] = set()
        for _ in range(100):
            seen |= {type(device.read(0.1)) for device in (lidar, wheels)}
            if {LaserScan, Odometry} <= seen:
                break
    assert {LaserScan, Odometry} <= seen


@pytest.mark.data
def test_a_real_recording_loses_nothing_on_the_way() -> None:
    shared = Path(os.environ.get("MAPQUILT_SHARED", Path(__file__).parents[3] / "shared"))
    path = shared / "data" / "carmen" / "intel.log.gz"
    if not path.is_file():
        pytest.skip(f"{path} is not here; set MAPQUILT_SHARED to the folder that holds data/carmen")
    recording = read_recording(path).part(1, 30)
    scans, track = replayed(recording, 8.0)
    assert len(scans) == len(recording.scans)
    assert sum(odometry.is_discontinuity for odometry in track[1:]) == 0


def test_a_log_without_a_clock_gets_the_time_that_its_way_takes(tmp_path: Path) -> None:
    words = [line.split() for line in log_text(4).splitlines()]
    stopped = [" ".join([*w[:-3], "0.0", "host", "0.0"]) if w[0] in ("ODOM", "FLASER") else " ".join(w) for w in words]
    (tmp_path / "a.clf").write_text("\n".join(stopped))
    scans = read_recording(tmp_path / "a.clf").scans
    for before, after, step in zip(scans, scans[1:], TRUE_STEPS, strict=False):
        assert after.stamp_s - before.stamp_s >= math.hypot(step.x_m, step.y_m)  # at most a metre a second


def test_the_odometry_on_the_way_to_a_scan_is_kept(log: Path) -> None:
    scan = read_recording(log).scans[1]
    assert [close_to(motion, step) for (_, motion), step in zip(scan.way, (SE2.identity(), TRUE_STEPS[0]), strict=True)] == [
        True
    ] * 2
    assert scan.written_s == 101.0
