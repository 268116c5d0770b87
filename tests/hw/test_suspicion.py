"""A damaged scan whose sum is right by chance: on a line that was damaged before, its wrong beams are left out."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from hw import scip, sick_wire
from hw.driver import Driver
from hw.hokuyo import Hokuyo
from hw.readings import LaserScan
from hw.sick_lms import SickLms
from hw.suspicion import SUSPECT_SCANS, Suspicion

WALL = [2000] * 181
FORGED = [*WALL[:90], 3100, *WALL[91:]]  # one beam is wrong, and every sum will be right


def sick(values: list[int]) -> bytes:
    return sick_wire.scan_telegram(values, is_mm=True)


def hokuyo(values: list[int]) -> bytes:
    return scip.encode_scan(b"MD0000018001000", 0, values)


@pytest.mark.parametrize(("driver", "encode"), [(SickLms(), sick), (Hokuyo(), hokuyo)], ids=["sick", "hokuyo"])
def test_a_forged_beam_is_left_out_long_after_the_line_was_damaged(driver: Driver, encode: Callable[[list[int]], bytes]) -> None:
    damaged = bytearray(encode(WALL))
    del damaged[50:55]
    stream = encode(WALL) + bytes(damaged) + encode(WALL) * 20 + encode(FORGED) + encode(WALL)
    scans = [scan for scan in driver.feed(stream, 1.0) if isinstance(scan, LaserScan)]
    ranges_m = np.array([scan.ranges_m for scan in scans[5:]])  # the first is eaten by the damage
    assert len(ranges_m) >= 16
    assert np.nanmax(np.abs(ranges_m - 2.0)) < 1e-3
    assert np.isnan(ranges_m[:, 90]).sum() == 1  # the forged beam; everybody else's is handed on


def test_a_line_is_trusted_again_after_many_clean_scans() -> None:
    line = Suspicion()
    assert not line
    line.note(0)
    line.note(3)
    for _ in range(SUSPECT_SCANS):
        assert line
        line.note(0)
    assert not line
