"""CARMEN logs in every dialect: the motion is that of the wheels, whoever wrote the log, and never a corrected pose."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from itertools import accumulate
from pathlib import Path

import numpy as np
import pytest

from hw.carmen import RecordedScan, Recording, read_recording
from hw.carmen_lines import beam_angles_rad
from hw.errors import DeviceConfigError
from hw.sim.replay import Replay
from protocol.geometry import SE2

STEP = SE2(0.3, 0.0, 0.1)  # of the wheels, from scan to scan
RAW = list(accumulate([STEP] * 11, lambda pose, step: pose @ step, initial=SE2(2.0, 1.0, 0.5)))
CORRECTED = list(accumulate([STEP @ SE2(-0.03, 0.05, 0.01)] * 11, lambda pose, step: pose @ step, initial=SE2(-5.0, 3.0, 2.0)))
OFFSET = SE2(0.22, 0.0, 0.0)
Read = Callable[..., Recording]


@pytest.fixture
def read(tmp_path: Path) -> Read:
    def written(lines: Iterator[str], name: str = "drive.log") -> Recording:
        (tmp_path / name).write_text("\n".join(lines) + "\n")
        return read_recording(tmp_path / name)

    return written


def told(pose: SE2) -> str:
    return f"{pose.x_m:.6f} {pose.y_m:.6f} {pose.theta_rad:.6f}"


def odom(pose: SE2, stamp_s: float) -> str:
    return f"ODOM {told(pose)} 0 0 0 {stamp_s} host {stamp_s}"


def flaser(k: int, laser: SE2, robot: SE2, stamp: str = "") -> str:
    return f"FLASER 4 1.0 2.0 {3 + 0.01 * k:.2f} 81.91 {told(laser)} {told(robot)} {stamp or k} host {k}"


def configured(kind: str, k: int, mode: str = "0 ", remissions: str = "0 ", poses: str = "", turn: str = "") -> str:
    return f"{kind} 0 -2.0 4.0 1.0 30.0 0.01 {mode}5 1.0 2.0 30.00 4.0 0.0 {remissions}{poses}{turn}{k} host {k}"


def is_step(scan: RecordedScan, step: SE2 = STEP) -> bool:
    return scan.motion is not None and scan.motion.distance_m(step) < 1e-4 and abs(scan.motion.theta_rad - step.theta_rad) < 1e-4


def restarted() -> Iterator[str]:
    """As Radish has it: after every scan the odometry begins again at the corrected pose."""
    pose = CORRECTED[0]
    for k, corrected in enumerate(CORRECTED):
        yield odom(pose, k - 0.1)
        yield flaser(k, corrected, corrected)
        yield odom(corrected, 0)
        yield odom(corrected @ SE2(0.15, 0.0, 0.05), k + 0.5)
        pose = corrected @ STEP


def raw() -> Iterator[str]:
    """Every scan bears the odometry of its moment, which is written again right after it."""
    yield "# message formats defined: PARAM SYNC ODOM FLASER RLASER TRUEPOS"
    for k, pose in enumerate(RAW):
        yield odom(pose @ SE2(-0.15, 0.0, -0.05), k - 0.5)
        yield flaser(k, pose @ OFFSET, pose)
        yield f"RLASER 4 1 1 1 1 {told(CORRECTED[k])} {told(CORRECTED[k])} {k} host {k}"
        yield odom(pose, k)


def paired() -> Iterator[str]:
    for k, pose in enumerate(RAW):
        yield flaser(k, pose, pose)
        yield odom(pose, k)


def apart() -> Iterator[str]:
    """The odometry goes on, the scans were corrected."""
    for k, pose in enumerate(RAW):
        yield odom(pose, k)
        yield flaser(k, CORRECTED[k], CORRECTED[k])


def scans_with_both() -> Iterator[str]:
    return (flaser(k, CORRECTED[k], pose) for k, pose in enumerate(RAW))


def scans_with_odometry() -> Iterator[str]:
    return (flaser(k, pose, pose) for k, pose in enumerate(RAW))


def robotlaser() -> Iterator[str]:
    for k, pose in enumerate(RAW):
        yield configured("RAWLASER1", k)
        yield configured("ROBOTLASER1", k, poses=f"{told(pose @ OFFSET)} {told(pose)} 0 0 0 0 ", turn="0 ")


def rawlaser() -> Iterator[str]:
    yield "PARAM robot_frontlaser_offset 0.22 1 host 1"
    for k, pose in enumerate(RAW):
        yield odom(pose, k)
        yield configured("RAWLASER1", k)


def laser_reading() -> Iterator[str]:
    for k, pose in enumerate(RAW):
        yield f"SM_UPDATE 1 {told(CORRECTED[k])} 0 {k}"
        yield f"LASER_READING 4 1 2 3 4 {told(pose)} {k}"


@pytest.mark.parametrize(
    "dialect", [restarted, raw, paired, apart, scans_with_both, scans_with_odometry, robotlaser, rawlaser, laser_reading]
)
def test_the_motion_is_that_of_the_wheels_in_every_dialect(dialect: Callable[[], Iterator[str]], read: Read) -> None:
    recording = read(dialect())
    assert len(recording.scans) == len(RAW)
    assert recording.scans[0].motion == SE2.identity()
    assert all(is_step(scan) for scan in recording.scans[1:])
    assert recording.scans[-1].stamp_s == pytest.approx(len(RAW) - 1)
    expected = OFFSET if dialect in (raw, robotlaser, rawlaser) else SE2.identity()
    assert (recording.T_base_laser or SE2.identity()).distance_m(expected) < 1e-5


def corrected_only() -> Iterator[str]:
    return (flaser(k, pose, pose) for k, pose in enumerate(CORRECTED))


@pytest.mark.parametrize(
    ("name", "before", "lines"),
    [
        ("drive.log", ["NEFF 12.0"], corrected_only),
        ("drive.gfs.log", [], corrected_only),
        ("drive.log", [], lambda: (flaser(k, pose, SE2.identity()) for k, pose in enumerate(CORRECTED))),
        ("drive.log", [], lambda: (configured("RAWLASER1", k) for k in range(12))),
    ],
)
def test_a_log_without_raw_odometry_has_no_motion(
    name: str, before: list[str], lines: Callable[[], Iterator[str]], read: Read, tmp_path: Path
) -> None:
    recording = read(iter([*before, *lines()]), name)
    assert not recording.has_odometry
    assert all(scan.motion is None for scan in recording.scans)
    assert recording.odometry.startswith("none")


@pytest.mark.parametrize("mode", ["0 ", ""])
@pytest.mark.parametrize("remissions", ["0 ", "5 9 9 9 9 9 ", ""])
@pytest.mark.parametrize("turn", ["0 ", ""])
def test_a_configured_laser_says_its_angles_and_its_range(mode: str, remissions: str, turn: str, read: Read) -> None:
    poses = "1 2 0.5 1 2 0.5 0 0 0 0 "
    scan = read(iter([configured("ROBOTLASER1", 7, mode, remissions, poses, turn)])).scans[0]
    assert scan.angles_rad.tolist() == [-2.0, -1.0, 0.0, 1.0, 2.0]
    assert scan.ranges_m.tolist() == [1.0, 2.0, math.inf, 4.0, math.inf]
    assert (scan.max_range_m, scan.written_s, scan.T_map_laser) == (30.0, 7.0, SE2(1.0, 2.0, 0.5))


@pytest.mark.parametrize(("beams", "first_deg", "step_deg"), [(541, -135, 0.5), (1081, -135, 0.25), (683, -119.88, 0.3516)])
def test_wider_scanners_are_known_by_their_number_of_beams(beams: int, first_deg: float, step_deg: float) -> None:
    angles = np.degrees(beam_angles_rad(beams))
    assert angles[0] == pytest.approx(first_deg, abs=0.02)
    assert np.diff(angles).mean() == pytest.approx(step_deg, abs=1e-3)


def stamps(recording: Recording) -> list[float]:
    return [scan.stamp_s for scan in recording.scans]


def test_a_clock_with_too_few_digits_gives_way_to_the_logger_s(read: Read) -> None:
    recording = read(flaser(k, pose, pose, stamp="1.07108e+09" if k < 6 else "1.07109e+09") for k, pose in enumerate(RAW))
    assert stamps(recording) == list(range(len(RAW)))


def test_a_clock_that_is_set_back_goes_on(read: Read) -> None:
    clock_s = [1000 + k if k < 6 else k for k in range(len(RAW))]  # of the driver and the logger both
    lines = (
        flaser(k, pose, pose, str(s)).rsplit(" ", 1)[0] + f" {s}" for k, (pose, s) in enumerate(zip(RAW, clock_s, strict=True))
    )
    steps = np.diff(stamps(read(lines)))
    assert np.delete(steps, 5).tolist() == [1.0] * 10
    assert 0 < steps[5] < 5


def test_a_robot_that_is_replayed_moves_as_its_lidar_did(read: Read) -> None:
    replay = Replay(read(raw()))
    left_m, right_m = replay.event_rolled_m[-1]
    assert (right_m - left_m) / 0.3 == pytest.approx(1.1, abs=1e-3)  # eleven steps of 0.1 rad
    laser = OFFSET.inverse() @ STEP @ OFFSET
    assert replay.recording.laser_motion(replay.recording.scans[1]).distance_m(laser) < 1e-5


def test_a_log_without_odometry_is_no_robot(tmp_path: Path) -> None:
    from hw.sim.replay_port import open_part  # noqa: PLC0415

    (tmp_path / "a.log").write_text("\n".join(configured("RAWLASER1", k) for k in range(3)))
    with pytest.raises(DeviceConfigError, match="no raw odometry in it"):
        open_part(str(tmp_path / "a.log"), "1/1")
