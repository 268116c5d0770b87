"""Units of a family that differ from the one that is simulated: other speeds, other frames, angles at the edge."""

from __future__ import annotations

import numpy as np
import pytest

from hw import ld06, ydlidar_wire
from hw.ld06 import Ld06
from hw.readings import LaserScan
from hw.spinning import SpinningLidar
from hw.ydlidar import YdLidar


def whole_scans(driver: SpinningLidar, frames: list[tuple[float, bytes]]) -> list[LaserScan]:
    scans = [scan for time_s, frame in frames for scan in driver.feed(frame, time_s)]
    return [scan for scan in scans if isinstance(scan, LaserScan) and not scan.is_partial]


@pytest.mark.parametrize(("model", "hz"), [("ld06", 5.0), ("ld06", 13.0), ("stl19p", 6.0), ("stl27l", 13.0)])
def test_an_ldrobot_lidar_turns_at_any_speed(model: str, hz: float) -> None:
    rate = ld06.MODELS[model].samples_per_s
    frames = []
    for k in range(round(4.5 * rate / hz / 12)):
        deg = (12 * k + np.arange(12)) * 360.0 * hz / rate % 360.0
        mm = tuple((2000 + 500 * np.sin(np.radians(deg))).astype(int).tolist())
        ends = int(100 * deg[0]), int(100 * deg[-1])
        packet = ld06.Packet(round(360 * hz), *ends, round(12e3 * (k + 1) / rate) % 30000, mm, (200,) * 12)
        frames.append((10.0 + 12 * (k + 1) / rate, ld06.encode(packet)))
    scans = whole_scans(Ld06(model), frames)
    assert len(scans) >= 2
    assert len(scans[-1].ranges_m) == pytest.approx(rate / hz, abs=1)
    assert np.abs(scans[-1].ranges_m - (2 - 0.5 * np.sin(scans[-1].angles_rad))).max() < 0.002


@pytest.mark.parametrize(("model", "rate", "hz", "most", "width"), [
    ("x2", 3000, 4.0, 40, 2), ("g4", 9000, 12.0, 40, 2), ("g2", 5000, 7.0, 40, 3), ("tmini", 4000, 10.0, 40, 4),
    ("tg30", 20000, 8.0, 80, 2),
])  # fmt: skip
def test_a_ydlidar_whose_last_sample_lies_at_360_degrees_loses_no_packet(
    model: str, rate: int, hz: float, most: int, width: int
) -> None:
    driver, kind = YdLidar(model), ydlidar_wire.MODELS[model]
    word, beams = (8000 if kind.is_triangle else 2000), round(rate / hz)
    q6 = np.rint(np.arange(beams) * 23040 / (beams - 1)).astype(int)  # the last of a turn says 360.0
    frames = []
    for turn in range(4):
        for first in range(0, beams, most):
            ends = q6[first : first + most]
            intensities = (90,) * len(ends) if width > 2 else ()
            packet = ydlidar_wire.Packet(False, 0.0, int(ends[0]), int(ends[-1]), (word,) * len(ends), intensities)
            zero = ydlidar_wire.Packet(True, hz, 0, 0, (word,), (90,) if width > 2 else ())
            start = b"" if first else ydlidar_wire.encode(zero, width)
            frames.append((10.0 + (turn + (first + len(ends)) / beams) / hz, start + ydlidar_wire.encode(packet, width)))
    scans = whole_scans(driver, frames)
    assert len(scans) >= 2 and driver.counters.rejected == 0
    assert scans[-1].ranges_m == pytest.approx(2.0)
    assert len(scans[-1].ranges_m) == pytest.approx(beams, abs=2)


def test_an_ldrobot_packet_may_end_at_360_degrees() -> None:
    frames = []
    for k in range(150):  # 12 beams a degree apart, 30 packets a turn
        first_deg = 12 * (k % 30) + 1
        packet = ld06.Packet(
            4500, 100 * first_deg, 100 * first_deg + 1100, round(8 * (k + 1) / 3) % 30000, (2000,) * 12, (200,) * 12
        )
        frames.append((10.0 + 12 * (k + 1) / 4500, ld06.encode(packet)))
    driver = Ld06("ld06")
    scans = whole_scans(driver, frames)
    assert len(scans) >= 3 and driver.counters.rejected == 0
    assert {len(scan.ranges_m) for scan in scans} == {360}
