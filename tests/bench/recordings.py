"""The recordings of ../shared/data as readings, as `mapquilt map` reads them, and what they are measured by."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from agent.recordings import Readings, carmen_readings, in_order
from hw.carmen import read_recording
from hw.readings import LaserScan, Odometry
from protocol.geometry import SE2

SHARED = Path(os.environ.get("MAPQUILT_SHARED", Path(__file__).resolve().parents[3] / "shared"))
SPARSE_M = 0.2  # scans farther apart than this have odometry's shape between them, not a straight line
RELATION_OFFSET_S = {"intel": 976052857.337, "freiburg-079": 1211.385}


@dataclass(frozen=True, slots=True)
class Recording:
    name: str
    readings: list[LaserScan | Odometry]  # in order of time, which is the order of the file
    reference: NDArray[np.float64]  # (N, 4) stamp as written and corrected pose of every scan
    scan_stamps_s: NDArray[np.float64]  # (N,) stamp of every scan among the readings
    odometry: NDArray[np.float64]  # (K, 4) stamp as written and raw pose, sorted by stamp
    scan_odometry: NDArray[np.float64]  # (N, 3) raw pose at every scan

    @property
    def scans(self) -> int:
        return len(self.reference)

    def dense(self, trajectory: NDArray[np.float64]) -> NDArray[np.float64]:
        """A trajectory of the mapper (its stamps) with the stamps of the file, and with odometry's shape between scans."""
        scan = np.interp(trajectory[:, 0], self.scan_stamps_s, np.arange(self.scans)).round().astype(int)
        order = np.argsort(self.reference[scan, 0], kind="stable")
        scan, poses = scan[order], trajectory[order, 1:]
        stamps = self.reference[scan, 0]
        rows = [np.column_stack([stamps, poses])]
        for k in np.flatnonzero(np.hypot(*(poses[1:, :2] - poses[:-1, :2]).T) > SPARSE_M):
            inside = self.odometry[
                np.searchsorted(self.odometry[:, 0], stamps[k], "right") : np.searchsorted(self.odometry[:, 0], stamps[k + 1])
            ]
            if len(inside):
                rows.append(
                    bridge(
                        poses[k],
                        poses[k + 1],
                        self.scan_odometry[scan[k]],
                        self.scan_odometry[scan[k + 1]],
                        inside,
                        stamps[k : k + 2],
                    )
                )
        dense = np.vstack(rows)
        return dense[np.argsort(dense[:, 0], kind="stable")]


def bridge(
    a: NDArray[np.float64],
    b: NDArray[np.float64],
    odometry_a: NDArray[np.float64],
    odometry_b: NDArray[np.float64],
    inside: NDArray[np.float64],
    ends_s: NDArray[np.float64],
) -> NDArray[np.float64]:
    """(K, 4) poses between two scans: odometry from the first, its error at the second spread evenly over time."""
    share = ((inside[:, 0] - ends_s[0]) / max(ends_s[1] - ends_s[0], 1e-9))[:, None]
    steps = relative(np.broadcast_to(odometry_a, (len(inside), 3)), inside[:, 1:])
    error = b - composed(a, relative(odometry_a[None], odometry_b[None]))[0]
    error[2] = (error[2] + math.pi) % math.tau - math.pi
    return np.column_stack([inside[:, 0], composed(a, steps) + share * error])


def composed(a: NDArray[np.float64], steps: NDArray[np.float64]) -> NDArray[np.float64]:
    """(K, 3) pose a moved by each of (K, 3) steps in its own frame."""
    cos, sin = math.cos(a[2]), math.sin(a[2])
    return np.stack(
        [a[0] + cos * steps[:, 0] - sin * steps[:, 1], a[1] + sin * steps[:, 0] + cos * steps[:, 1], a[2] + steps[:, 2]], axis=1
    )


def load(name: str) -> Recording:
    """One recording with the odometry a robot would have had."""
    scans = read_recording(SHARED / "data" / "carmen" / f"{name}.log.gz").scans
    readings = in_order(Readings(name, list(carmen_readings(scans)))).readings
    raw, odometry, scan_odometry = SE2.identity(), [], []
    for scan in scans:
        odometry += [[stamp_s, *as_row(raw @ motion)] for stamp_s, motion in scan.way]
        raw = raw @ (scan.motion or SE2.identity())
        scan_odometry.append(as_row(raw))
    ordered = np.array(sorted(odometry))
    ordered[:, 3] = np.unwrap(ordered[:, 3])
    reference = np.array([[scan.written_s, *as_row(scan.T_map_laser)] for scan in scans])
    stamps_s = np.array([r.stamp_s for r in readings if isinstance(r, LaserScan)])
    return Recording(name, list(readings), reference, stamps_s, ordered, np.array(scan_odometry))


def as_row(pose: SE2) -> list[float]:
    return [pose.x_m, pose.y_m, pose.theta_rad]


def relation_errors(name: str, trajectory: NDArray[np.float64]) -> NDArray[np.float64]:
    """(K, 2) metres and radians: error of every hand-checked relative pose (Kuemmerle et al., 2009)."""
    table = np.loadtxt(SHARED / "data" / "relations" / f"{name}.relations")
    t1, t2 = table[:, 0] - RELATION_OFFSET_S[name], table[:, 1] - RELATION_OFFSET_S[name]
    inside = (np.minimum(t1, t2) >= trajectory[0, 0] - 0.5) & (np.maximum(t1, t2) <= trajectory[-1, 0] + 0.5)
    estimated = relative(poses_at(trajectory, t1[inside]), poses_at(trajectory, t2[inside]))
    true = table[inside][:, [2, 3, 7]]
    return errors(true, estimated)


def corrected_errors(
    reference: NDArray[np.float64], trajectory: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Errors against the corrected log: consecutive scans, and loop pairs (more than 50 scans apart, less than 3 m)."""
    estimated = poses_at(trajectory, reference[:, 0])
    true = reference[:, 1:]
    consecutive = errors(relative(true[:-1], true[1:]), relative(estimated[:-1], estimated[1:]))
    i, j = np.triu_indices(len(true), 51)
    near = np.hypot(*(true[i, :2] - true[j, :2]).T) < 3.0
    i, j = i[near], j[near]
    return consecutive, errors(relative(true[i], true[j]), relative(estimated[i], estimated[j]))


def poses_at(trajectory: NDArray[np.float64], stamps_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """(K, 3) poses at moments, straight between the trajectory's."""
    theta = np.unwrap(trajectory[:, 3])
    columns = (trajectory[:, 1], trajectory[:, 2], theta)
    return np.stack([np.interp(stamps_s, trajectory[:, 0], column) for column in columns], axis=1)


def relative(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """(K, 3) b seen from a."""
    d = b - a
    cos, sin = np.cos(a[:, 2]), np.sin(a[:, 2])
    return np.stack([cos * d[:, 0] + sin * d[:, 1], -sin * d[:, 0] + cos * d[:, 1], d[:, 2]], axis=1)


def errors(true: NDArray[np.float64], estimated: NDArray[np.float64]) -> NDArray[np.float64]:
    """(K, 2) metres and radians of true^-1 estimated."""
    d = relative(true, estimated)
    return np.stack([np.hypot(d[:, 0], d[:, 1]), np.abs((d[:, 2] + math.pi) % math.tau - math.pi)], axis=1)
