"""Revolutions are cut where the head passes zero, and doubtful beams say nothing."""

from __future__ import annotations

import numpy as np
import pytest

from hw.clock import DeviceClock
from hw.scan_assembler import Beams, ScanAssembler, coverage_of, is_evenly_spaced, supported_only
from hw.xv11 import LDS01, Xv11


def _beams(turns: np.ndarray, begin_s: float = 0.0, dirty: bool = False) -> Beams:
    turn_deg = turns % 360.0
    stamps_s = begin_s + (turns - turns[0]) / 3600.0
    return Beams(turn_deg, -np.radians(turn_deg), np.full(len(turns), 2.0), stamps_s, None, np.full(len(turns), dirty))


def test_scans_are_cut_at_the_turn_and_the_unfinished_ends_are_not_handed_on() -> None:
    scans = ScanAssembler(0.1, 10.0).add(_beams(np.arange(100.0, 1900.0)))
    assert [len(scan.ranges_m) for scan in scans] == [360, 360, 360, 360]
    assert not any(scan.is_partial for scan in scans)
    assert scans[0].angles_rad[1] < 0, "clockwise turns become counter-clockwise angles"


def test_a_tenth_of_a_turn_missing_is_partial() -> None:
    turns = np.concatenate([np.arange(0.0, 800.0), np.arange(836.0, 1500.0)])
    assert [scan.is_partial for scan in ScanAssembler(0.1, 10.0).add(_beams(turns))] == [False, True, False]


def test_after_half_a_turn_missing_the_next_cut_is_waited_for() -> None:
    turns = np.concatenate([np.arange(0.0, 760.0), np.arange(1000.0, 2200.0)])
    scans = ScanAssembler(0.1, 10.0).add(_beams(turns))
    stamps = [round(scan.stamp_s * 3600) for scan in scans]
    assert stamps == [360, 1080, 1440, 1800]


def test_ranges_outside_the_limits_are_invalid_and_infinity_stays() -> None:
    beams = _beams(np.arange(0.0, 1100.0))
    beams.ranges_m[360:364] = [0.05, 11.0, np.inf, np.nan]
    scan = ScanAssembler(0.1, 10.0).add(beams)[0]
    assert np.isnan(scan.ranges_m[[0, 1, 3]]).all() and np.isinf(scan.ranges_m[2])


def test_on_a_dirty_line_a_lone_beam_says_nothing() -> None:
    for dirty in (False, True):
        beams = _beams(np.arange(0.0, 1100.0), dirty=dirty)
        beams.ranges_m[500] = 2.3
        scan = ScanAssembler(0.1, 10.0).add(beams)[0]
        assert np.isnan(scan.ranges_m[140]) == dirty


def test_a_slanting_wall_supports_its_beams_and_an_edge_does_not() -> None:
    wall = 2.0 + 0.02 * np.arange(50.0)
    assert np.isfinite(supported_only(wall)[2:-2]).all()
    edge = np.where(np.arange(50) < 25, 2.0, 4.0)
    assert np.flatnonzero(np.isnan(supported_only(edge)[2:-2])).tolist() == [21, 22, 23, 24]
    shifted = wall.copy()
    shifted[20:23] += 0.5
    assert np.isnan(supported_only(shifted, (1, 3))[20:23]).all()


def test_neighbours_damaged_alike_do_not_bear_one_another_out() -> None:
    """What an LD06 on a bad line really sent: 2.447 m between 2.505 m and a damaged 2.38 m; 5.484 m across a corner of 5.58 m."""
    pair = np.array([2.5, 2.5, 2.501, 2.502, 2.503, 2.505, 2.447, 2.38, 2.514, 2.518, 2.522, 2.527])
    assert np.isnan(supported_only(pair)[6])
    corner = np.array([5.408, 5.44, 5.473, 5.508, 5.544, 5.484, 5.46, 5.325, 5.189, 5.061])
    assert np.isnan(supported_only(corner)[5])
    assert np.isfinite([supported_only(values, (1,))[at] for values, at in ((pair, 6), (corner, 5))]).all()


def test_an_angle_out_of_line_is_seen() -> None:
    angles = -np.radians(np.arange(0.0, 360.0))
    angles[100] += np.radians(2.0)
    assert np.flatnonzero(~is_evenly_spaced(angles, (1,))).tolist() == [99, 100, 101]
    angles[99] += np.radians(1.0)  # half of its neighbour's error: it lies midway again
    assert is_evenly_spaced(angles, (1,))[99] and not is_evenly_spaced(angles)[99]


def test_coverage_counts_what_is_missing() -> None:
    full = np.arange(0.0, 360.0, 0.8)
    assert coverage_of(full) == 1.0
    assert abs(coverage_of(full[(full < 90) | (full >= 180)]) - 0.75) < 0.01


def test_a_stuck_head_does_not_fill_the_memory() -> None:
    assembler = ScanAssembler(0.1, 10.0)
    for k in range(100):
        assembler.add(_beams(np.full(1000, 90.0), begin_s=k * 0.01))
    assert assembler._pending_n <= 21000


def test_the_clock_follows_the_earliest_arrivals_and_wraps() -> None:
    clock = DeviceClock(30.0)
    rng = np.random.default_rng(2)
    worst_s = 0.0
    for k in range(8000):
        true_s = 0.1 * k
        device_s = (true_s * (1 + 50e-6) + 27.0) % 30.0
        arrival_s = 1000.0 + true_s + float(rng.exponential(0.004))
        host_s = clock.to_host(device_s, arrival_s)
        assert host_s <= arrival_s + 1e-9
        if k > 100:
            worst_s = max(worst_s, abs(host_s - (1000.0 + true_s)))
    assert worst_s < 0.004


def test_a_clock_that_begins_anew_is_followed() -> None:
    clock = DeviceClock(30.0)
    for k in range(100):
        clock.to_host(10.0 + 0.1 * k, 500.0 + 0.1 * k)
    assert clock.to_host(0.0, 510.0) == 510.0
    assert abs(clock.to_host(0.1, 510.11) - 510.1) < 0.02


@pytest.mark.parametrize("stall_s", [0.4, 0.9, 3.0])
def test_what_waited_while_nobody_read_keeps_its_time(stall_s: float) -> None:
    """A host that was busy finds a line full of old messages, the newest of which may have been lost."""
    clock = DeviceClock(30.0)
    for sent_s in np.arange(0.0, 20.0, 0.02):
        is_waiting = 10.0 <= sent_s < 10.0 + stall_s
        if 10.0 + 0.7 * stall_s < sent_s < 10.0 + stall_s:
            continue
        arrival_s = 500.0 + (10.0 + stall_s if is_waiting else sent_s)
        assert abs(clock.to_host((sent_s + 20.0) % 30.0, arrival_s) - 500.0 - sent_s) < 1e-3


def test_a_clock_that_stood_still_is_believed_again() -> None:
    clock = DeviceClock(30.0)
    sent_s = np.concatenate([np.arange(0.0, 10.0, 0.02), np.arange(10.8, 13.0, 0.02)])
    host_s = [clock.to_host(0.02 * k, 500.0 + float(at_s)) for k, at_s in enumerate(sent_s)]
    assert abs(host_s[-1] - 500.0 - sent_s[-1]) < 1e-3


def test_a_packet_of_another_place_does_not_bear_itself_out() -> None:
    """Six beams of an LDS-01 whose index was damaged, at the edge of a hole: only what lies outside of the packet tells."""
    packet = np.array([2.31, 2.39, 2.475, 2.556, 2.643, 2.735])
    seen = np.concatenate([[2.519, 2.524, 2.531, 2.538, 2.546, 2.555], packet, [np.nan] * 6])
    assert np.isfinite(supported_only(seen)[6:12]).any()
    assert np.isnan(supported_only(seen, Xv11(LDS01)._assembler.witnesses)[6:12]).all()
