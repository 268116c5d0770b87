"""YDLIDAR, Hokuyo, SICK and XV-11: what is written is read, and what the devices say besides ranges is understood."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hw import ld06, scip, sick_wire, xv11, ydlidar_wire
from hw.hokuyo import Hokuyo
from hw.sick_lms import SickLms
from hw.ydlidar import YdLidar
from tests.harness.lidar_streams import STREAMS, decode

words = st.integers(0, 65535)


@settings(max_examples=50, deadline=None)
@given(st.data(), st.integers(1, 80), st.sampled_from([2, 3, 4]))
def test_ydlidar_packets_of_every_width(data: st.DataObject, n: int, width: int) -> None:
    samples = tuple(data.draw(st.lists(words, min_size=n, max_size=n)))
    most = {2: 0, 3: 255, 4: 65535}[width]
    intensities = tuple(data.draw(st.lists(st.integers(0, most), min_size=n, max_size=n))) if width > 2 else ()
    packet = ydlidar_wire.Packet(n == 1, 7.5 if n == 1 else 0.0, 100, 2000, samples, intensities)
    assert ydlidar_wire.decode(ydlidar_wire.encode(packet, width)) == packet


def test_ydlidar_clock_packets_between_scan_packets_are_no_damage() -> None:
    stream = STREAMS["ydlidar-2B"](seconds=1.0)
    packets, at = [], 0
    while at < len(stream.data):
        end = at + 10 + 2 * stream.data[at + 3]
        packets.append(stream.data[at:end] + ydlidar_wire.encode_clock(at))
        at = end
    driver = YdLidar("g4")
    scans = decode(stream, b"".join(packets), chunk=200, driver=driver)
    assert len(scans) >= 6
    assert (driver.counters.bad_frames, driver.counters.skipped_bytes) == (0, 0)


def test_a_ydlidar_packet_that_ran_backwards_is_refused() -> None:
    """Seen in a real X4 capture: a good checksum, and LSA 1.2 degrees before FSA."""
    stream = STREAMS["ydlidar-2B"](seconds=1.0)
    backwards = ydlidar_wire.encode(ydlidar_wire.Packet(False, 0.0, round(223.34 * 64), round(222.17 * 64), (4000,) * 40))
    at = 12 + 6 * 90  # behind the start packet and six others
    driver = YdLidar("g4")
    scans = decode(stream, stream.data[: 4 * 1142 + at] + backwards + stream.data[4 * 1142 + at :], chunk=300, driver=driver)
    assert driver.counters.rejected >= 1
    assert all(len(scan.ranges_m) <= 501 for scan in scans)


def test_tof_ydlidars_count_whole_millimetres_and_are_not_corrected() -> None:
    driver = YdLidar("tg30")
    frames = np.zeros((1, 330), np.uint8)
    frames[0, 10:14] = [0x10, 0x27, 0x00, 0x00]
    driver._width = 2
    assert driver._samples(frames)[0][0, :2].tolist() == [10000.0, 0.0]


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**24 - 1), st.integers(2, 4))
def test_scip_values(value: int, characters: int) -> None:
    value %= 64**characters
    text = scip.encode_value(value, characters)
    assert all(0x30 <= byte <= 0x6F for byte in text)
    assert scip.decode_value(text) == value


@pytest.mark.parametrize("echo", [b"MD0000010000100", b"MS0000010000100", b"ME0000010000100", b"GD0000010000"])
def test_hokuyo_scan_messages(echo: bytes) -> None:
    mm = [(37 * k) % 4096 for k in range(101)]
    intensities = [k * 11 for k in range(101)] if echo[1:2] == b"E" else None
    message = scip.decode_message(scip.encode_scan(echo, 123456, mm, intensities)[:-2])
    assert message is not None
    scan = scip.scan_of(message)
    assert scan is not None
    assert (scan.clock_ms, scan.values.tolist()) == (123456, mm)
    assert (scan.intensities.tolist() if scan.intensities is not None else None) == intensities


def test_hokuyo_error_codes_are_no_ranges_and_nothing_in_range_is_free_only_when_asked() -> None:
    parameters = scip.encode_message(b"PP", b"00", scip.UTM_30LX.lines())
    data = parameters + scip.encode_scan(b"MD0000108001000", 0, [1, 2, 5, 22, 23, 60000] + [1000] * 1075)
    for is_free, first in ((False, np.nan), (True, np.inf)):
        scan = Hokuyo(sees_nothing_as_free=is_free).feed(data, 1.0)[0]
        assert np.array_equal(scan.ranges_m[:4], np.array([first, np.nan, np.nan, np.nan], np.float32), equal_nan=True)
        assert scan.ranges_m[4:7].tolist() == pytest.approx([0.023, 60.0, 1.0])


def test_a_lost_message_end_costs_the_hokuyo_one_scan() -> None:
    stream = STREAMS["hokuyo-urg"](seconds=1.0)
    size = len(stream.data) // 10
    for at in (size - 1, 3 * size - 2, 5 * size - 1):
        scans = decode(stream, stream.prefix + stream.data[:at] + stream.data[at + 1 :], chunk=512)
        assert len(scans) >= 9


def test_hokuyo_sums_with_and_without_the_semicolon_are_both_read() -> None:
    assert scip.is_line_good(b"DMIN:20;4")
    with_semicolon = b"DMIN:20;"
    assert scip.is_line_good(with_semicolon + bytes((scip.line_sum(with_semicolon),)))
    assert not scip.is_line_good(b"DMIN:21;4")


def test_a_hokuyo_block_that_ends_in_a_semicolon_has_the_sum_of_all_its_characters() -> None:
    clock_ms = scip.decode_value(b"a<l;")
    line = scip.encode_scan(b"GD0000000101", clock_ms, [1, 2]).split(b"\n")[2]
    assert line == b"a<l;" + bytes((scip.line_sum(b"a<l;"),))
    assert not scip.is_line_good(b"a<l;" + bytes((scip.line_sum(b"a<l"),)), is_text=False)


@pytest.mark.parametrize("n", sick_wire.FIELDS)
def test_sick_scans_of_every_field(n: int) -> None:
    telegram = sick_wire.scan_telegram([500 + k % 300 for k in range(n)])
    scan = SickLms().feed(telegram, 10.0)[0]
    field_deg, step_deg = sick_wire.FIELDS[n]
    assert len(scan.ranges_m) == n
    assert np.degrees(scan.angles_rad[[0, -1]]).tolist() == pytest.approx([-field_deg / 2, field_deg / 2])
    assert np.degrees(scan.angles_rad[1] - scan.angles_rad[0]) == pytest.approx(step_deg, abs=1e-4)
    assert scan.ranges_m[0] == pytest.approx(5.0)


def test_sick_flags_and_codes_are_no_ranges() -> None:
    values = [0x2000 | 800, 0x1FF7, 0, 0x1FFF] + [800] * 177
    metres = sick_wire.ranges_m(sick_wire.ScanPayload(tuple(values)))
    assert np.array_equal(metres[:5], [8.0, np.nan, np.nan, np.nan, 8.0], equal_nan=True)


@pytest.mark.parametrize(("mode", "seen"), [
    (0, [8.0, 8.0, 7.807, np.nan, np.nan, np.nan]), (4, [8.0, 16.192, 15.999, 8.191, np.nan, np.nan]),
    (6, [8.0, 16.192, 15.999, 8.191, 16.383, np.nan]), (None, [8.0, 16.192, 15.999, np.nan, np.nan, np.nan]),
])  # fmt: skip
def test_what_is_nothing_in_millimetres_depends_on_the_measuring_mode(mode: int | None, seen: list[float]) -> None:
    values = [8000, 0x2000 | 8000, 15999, 0x1FFF, 0x3FFF, 0x7FF7] + [8000] * 175
    metres = sick_wire.ranges_m(sick_wire.ScanPayload(tuple(values), is_mm=True), mode)
    assert np.allclose(metres[:6], seen, equal_nan=True)


def test_a_sick_that_numbers_its_scans_is_understood() -> None:
    numbered = sick_wire.ScanPayload((800,) * 361).encode()[:-1] + b"\x07\x10"
    (scan,) = SickLms().feed(sick_wire.encode(numbered, sick_wire.SCANNER_ADDRESS), 1.0)
    assert (scan.ranges_m == 8.0).all()


def test_a_sick_in_a_hall_beyond_its_eight_metres_draws_no_wall_there() -> None:
    driver = SickLms()
    assert np.isnan(driver.feed(sick_wire.scan_telegram([0x1FFF] * 181, is_mm=True), 1.0)[0].ranges_m).all()


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 89), st.lists(st.integers(0, 0x3FFF), min_size=4, max_size=4), st.lists(words, min_size=4, max_size=4))
def test_xv11_packets(index: int, mm: list[int], signals: list[int]) -> None:
    packet = xv11.Packet(index, 300.0, tuple(mm), tuple(signals), (True, False, False, True), (False, True, False, False))
    assert xv11.decode_xv11(xv11.encode_xv11(packet)) == packet


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 59), st.lists(words, min_size=6, max_size=6), st.lists(words, min_size=6, max_size=6))
def test_lds01_packets(index: int, mm: list[int], signals: list[int]) -> None:
    packet = xv11.Packet(index, 298.7, tuple(mm), tuple(signals))
    assert xv11.decode_lds01(xv11.encode_lds01(packet)) == packet


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 65535), st.integers(0, 35999), st.integers(0, 29999), st.lists(words, min_size=12, max_size=12))
def test_ldrobot_packets(speed: int, start: int, clock_ms: int, mm: list[int]) -> None:
    packet = ld06.Packet(speed, start, (start + 880) % 36000, clock_ms, tuple(mm), tuple(range(12)))
    assert ld06.decode(ld06.encode(packet)) == packet


def test_on_a_bad_line_a_sick_scan_waits_until_the_next_one_begins_right_behind_it() -> None:
    driver, telegram = SickLms(), sick_wire.scan_telegram([800] * 181)
    assert len(driver.feed(telegram, 1.0)) == 1, "on a clean line at once"
    assert driver.feed(b"\0\0\0" + telegram, 2.0) == []
    assert len(driver.feed(telegram[:4], 3.0)) == 1
    assert driver.feed(telegram[4:] + b"\0\0\0", 4.0) == [], "what follows is no telegram: it may have eaten of one"
