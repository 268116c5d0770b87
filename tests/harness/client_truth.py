"""How far what another program read from our simulators is from what there was to read."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from hw.sim.catalogue import BASES
from hw.sim.raycast import cast_all
from hw.sim.robot import SimulatedRobot
from hw.sim.world import open_world
from tests.harness.serial_device import POSE, ROOM

Rows = list[list[float]]  # of a LIDAR [degrees counter-clockwise, metres], of a base [seconds, left ticks, right ticks]
ROBOT_SEED = 3
BEGUN_BEFORE_S = 12.0  # a client has begun to read so long after the robot was started
DRIVE = "drive"  # the mode in which a client turns the wheels
TOLD_MPS = (0.10, 0.15)  # left, right: what it tells them, see `foreign_clients.py`
NO_ERRORS = np.empty(0), np.empty(0)


def wall_errors_m(beams: Rows) -> np.ndarray:
    """How far each range is from the wall at its bearing."""
    seen = np.array([beam for beam in beams if 0.05 < beam[1] < 20.0]).reshape(-1, 2)
    bearings = POSE.theta_rad + np.radians(seen[:, 0])
    origins = np.tile([POSE.x_m, POSE.y_m], (len(seen), 1))
    return np.abs(cast_all(ROOM.segments, origins, bearings, 100.0) - seen[:, 1])


def way_errors_m(device: str, rows: Rows) -> tuple[np.ndarray, np.ndarray]:
    """How far the ways of both wheels are from the ways they went, and how far when left is taken for right.

    The robot goes the same way for the same seed, so it is driven once more here; when the client began to read is not known
    and found as the moment at which the readings fit best.
    """
    if len(rows) < 10:
        return NO_ERRORS
    drive, world = BASES[device].drive, open_world("office")
    robot = SimulatedRobot(world, world.start_poses(1, ROBOT_SEED)[0], ROBOT_SEED, replace(drive))
    robot.begin()
    step_s = 0.005
    clock_s = np.arange(0.0, 45.0, step_s)
    robot.poses_at(clock_s[:1])
    went_m = robot.poses_at(clock_s)[:, 3:5]
    seconds, read_m = _ways_m(device, rows)
    later = np.round(seconds / step_s).astype(int)
    begins = np.arange(round(BEGUN_BEFORE_S / step_s))

    def best(ways_m: np.ndarray) -> np.ndarray:
        true_m = ways_m[begins[:, None] + later] - ways_m[begins, None]
        errors = np.abs(true_m - read_m)
        return errors[np.argmin(np.median(errors, axis=(1, 2)))].ravel()

    return best(went_m), best(went_m[:, ::-1])


def driven_errors_m(device: str, rows: Rows) -> tuple[np.ndarray, np.ndarray]:
    """How far the wheels are from where the client sent them, and how far when left is taken for right."""
    if len(rows) < 10:
        return NO_ERRORS
    seconds, read_m = _ways_m(device, rows)
    told_m = seconds[:, None] * np.array(TOLD_MPS)
    return np.abs(read_m - told_m).ravel(), np.abs(read_m - told_m[:, ::-1]).ravel()


def _ways_m(device: str, rows: Rows) -> tuple[np.ndarray, np.ndarray]:
    """(N,) seconds since the first reading, (N, 2) metres that left and right wheel have rolled since."""
    drive, read = BASES[device].drive, np.array(rows)
    bits = 16 if device in ("create2", "kobuki") else 32
    ticks = np.cumsum((np.diff(read[:, 1:], axis=0) + 2 ** (bits - 1)) % 2**bits - 2 ** (bits - 1), axis=0)
    return read[1:, 0] - read[0, 0], ticks * math.tau * drive.wheel_radius_m / drive.ticks_per_revolution
