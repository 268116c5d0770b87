"""A recording of somebody's robot as readings, whatever it was written with: a CARMEN log, or a rosbag2 / MCAP file.

recording = open_recording("intel.log.gz")
for reading in recording.readings: ...          # Odometry before the scan it belongs to, stamps strictly growing
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from hw.carmen import RecordedScan, read_recording
from hw.errors import DeviceConfigError
from hw.log_files import refuse_endless
from hw.readings import LaserScan, Odometry
from hw.recorder import MAGIC
from protocol.geometry import SE2

LONGEST_STEP_S = 1e-6  # stamps that repeat or go back follow the one before by this


class RecordingError(Exception):
    """A recording that cannot be read: says which, what was seen, and what to try."""


@dataclass(frozen=True, slots=True)
class Readings:
    """What a recording holds; `first_stamp_s` is the wall clock at stamp 0 when the recording says."""

    name: str
    readings: Sequence[LaserScan | Odometry]
    first_stamp_s: float = 0.0
    T_base_laser: SE2 | None = None  # where the LIDAR sat, when the recording says
    odometry: str = ""  # where in the recording it was found

    @property
    def scans(self) -> int:
        return sum(isinstance(reading, LaserScan) for reading in self.readings)


def open_recording(path: Path, scan_topic: str | None = None, odometry_topic: str | None = None) -> Readings:
    """By what the file is; RecordingError when it is none of those."""
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        raise RecordingError(f"{path}: a folder without metadata.yaml; is this a rosbag2 recording?")
    try:
        if not path.is_dir():
            refuse_endless(path)
    except DeviceConfigError as error:
        raise RecordingError(str(error)) from error
    if path.is_dir() or path.suffix in (".mcap", ".db3", ".bag"):
        from agent.rosbags_reader import read_bag  # noqa: PLC0415  an optional package

        return in_order(read_bag(path, scan_topic, odometry_topic))
    try:
        with path.open("rb") as stream:
            if stream.read(len(MAGIC)) == MAGIC:
                raise RecordingError(
                    f"{path}: the bytes of one device, as mapquilt record keeps them; be the robot that saw them: "
                    "mapquilt run --lidar replay:FILE --wheels replay:FILE"
                )
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror or error}") from error
    try:
        recording = read_recording(path)
    except DeviceConfigError as error:
        raise RecordingError(str(error)) from error
    readings = carmen_readings(recording.scans) if recording.has_odometry else (scan.laser_scan() for scan in recording.scans)
    return in_order(Readings(recording.name, list(readings), T_base_laser=recording.T_base_laser, odometry=recording.odometry))


def carmen_readings(scans: Iterable[RecordedScan]) -> Iterator[LaserScan | Odometry]:
    """Motions from scan to scan, chained to the odometry a robot would have had; an unknown one is a discontinuity."""
    T_odom_base, before_s = SE2.identity(), 0.0
    for scan in scans:
        for k, (_, motion) in enumerate(scan.way[:-1], 1):  # evenly in time: what the loggers wrote is out of order or zero
            on_the_way = T_odom_base @ motion
            stamp_s = before_s + (scan.stamp_s - before_s) * k / len(scan.way)
            yield Odometry(stamp_s, on_the_way.x_m, on_the_way.y_m, on_the_way.theta_rad)
        if scan.motion is not None:
            T_odom_base = T_odom_base @ scan.motion
        before_s = scan.stamp_s
        yield Odometry(scan.stamp_s, T_odom_base.x_m, T_odom_base.y_m, T_odom_base.theta_rad, scan.motion is None)
        yield scan.laser_scan()


def in_order(recording: Readings) -> Readings:
    """With stamps that grow: some loggers wrote out of order, some repeat a stamp."""
    ordered: list[LaserScan | Odometry] = []
    last_s = float("-inf")
    for reading in recording.readings:
        stamp_s = (
            max(reading.stamp_s, last_s) if isinstance(reading, LaserScan) else max(reading.stamp_s, last_s + LONGEST_STEP_S)
        )
        ordered.append(reading if stamp_s == reading.stamp_s else replace(reading, stamp_s=stamp_s))
        last_s = stamp_s
    return replace(recording, readings=ordered)
