"""Laws every LIDAR driver obeys, on a stream of its own bytes that sees a known room."""

from __future__ import annotations

import numpy as np
import pytest

from hw.readings import LaserScan
from tests.harness.lidar_streams import STREAMS, Stream, decode, errors_m

SPINNING = [name for name in STREAMS if not name.startswith(("hokuyo", "sick"))]
CHECKED = [name for name in STREAMS if name != "rplidar-0x81"]
_cache: dict[str, Stream] = {}


def _stream(name: str) -> Stream:
    if name not in _cache:
        _cache[name] = STREAMS[name](seconds=1.0)
    return _cache[name]


def _keys(scans: list[LaserScan]) -> list[tuple[bytes, bytes]]:
    return [(scan.ranges_m.tobytes(), scan.angles_rad.tobytes()) for scan in scans]


@pytest.mark.parametrize("name", STREAMS)
def test_scans_show_the_room(name: str) -> None:
    stream = _stream(name)
    scans = decode(stream, stream.prefix + stream.data, chunk=256)
    assert len(scans) >= 2
    for scan in scans:
        assert not scan.is_partial
        assert np.nanmax(errors_m(scan.angles_rad, scan.ranges_m)) < 0.012  # the coarsest steps are those of the capsules
        assert np.isfinite(scan.ranges_m).mean() > (0.35 if name == "lds01" else 0.95)  # an LDS-01 sees 3.5 m


@pytest.mark.parametrize("name", STREAMS)
def test_whole_and_byte_by_byte_are_the_same(name: str) -> None:
    stream = _stream(name)
    data = stream.prefix + stream.data[: len(stream.data) // 2] * 2
    whole, by_byte = _keys(decode(stream, data)), _keys(decode(stream, data, chunk=1))
    n = min(len(whole), len(by_byte))  # a whole feed may decode the last turn one frame earlier
    assert n >= 1 and abs(len(whole) - len(by_byte)) <= 1
    assert whole[:n] == by_byte[:n]


@pytest.mark.parametrize("name", STREAMS)
def test_garbage_before_is_skipped(name: str) -> None:
    stream = STREAMS[name](seconds=3.0) if name == "sick" else _stream(name)
    garbage = np.random.default_rng(5).integers(0, 256, 700, dtype=np.uint8).tobytes()
    clean = _keys(decode(stream, stream.prefix + stream.data))
    if stream.prefix:
        dirty = _keys(decode(stream, garbage + b"\n\n" + stream.prefix + stream.data))
    else:
        dirty = _keys(decode(stream, garbage + stream.data))
    n = len(clean) - (9 if name.startswith(("sick", "hokuyo")) else 2)  # nine scans behind a first gap are looked at twice
    assert dirty[-n:] == clean[-n:]


@pytest.mark.parametrize("name", SPINNING)
def test_a_revolution_with_a_hole_is_partial_and_says_nothing_wrong(name: str) -> None:
    stream = _stream(name)
    n = len(stream.data)
    hole = n // 2 + n // 50, n // 2 + n // 20  # 30 % of a turn at 10 Hz
    scans = decode(stream, stream.prefix + stream.data[: hole[0]] + stream.data[hole[1] :], chunk=256)
    assert any(scan.is_partial for scan in scans)
    for scan in scans:
        assert not (np.nan_to_num(errors_m(scan.angles_rad, scan.ranges_m)) > 0.05).any()


@pytest.mark.parametrize("name", STREAMS)
def test_beams_are_dated_in_order_and_fill_the_turn(name: str) -> None:
    stream = _stream(name)
    scans = decode(stream, stream.prefix + stream.data, chunk=256)
    for scan in scans:
        assert scan.time_offsets_s is not None
        assert (np.diff(scan.time_offsets_s) >= 0).all()
        assert scan.time_offsets_s[-1] == pytest.approx(scan.duration_s, abs=1e-4)
    ends = [scan.stamp_s + scan.duration_s for scan in scans]
    assert (np.diff([scan.stamp_s for scan in scans]) > 0).all()
    assert (np.array(ends) <= 100.0 + stream.seconds + 0.01).all()
    if name in SPINNING:
        period_s = float(np.median(np.diff([scan.stamp_s for scan in scans])))
        assert scans[-1].duration_s == pytest.approx(period_s, rel=0.12)


@pytest.mark.parametrize("name", SPINNING)
def test_the_first_revolution_which_nobody_saw_begin_is_not_handed_on(name: str) -> None:
    stream = _stream(name)
    frame = len(stream.data) // 7
    turns = round(stream.seconds * (5 if name in ("rplidar-0x81", "xv11", "lds01") else 10))
    assert len(decode(stream, stream.prefix + stream.data[frame:])) < turns


@pytest.mark.parametrize("name", CHECKED)
@pytest.mark.parametrize("share", [0.0005, 0.01])
def test_bytes_lost_and_flipped_make_no_wrong_scan(name: str, share: float) -> None:
    stream = _stream(name)
    rng = np.random.default_rng(17)
    data = np.frombuffer(stream.data * 3, np.uint8).copy()
    flipped = rng.random(len(data)) < share / 2
    data[flipped] ^= (1 << rng.integers(0, 8, int(flipped.sum()))).astype(np.uint8)
    data = data[rng.random(len(data)) >= share / 2]
    scans = decode(stream, stream.prefix + data.tobytes(), chunk=4096)
    wrong = sum(bool((np.nan_to_num(errors_m(scan.angles_rad, scan.ranges_m)) > 0.05).any()) for scan in scans)
    assert wrong == 0
    if share < 0.001:
        assert scans
    clean = decode(stream, stream.prefix + data.tobytes() + stream.data * 2, chunk=4096)
    assert sum(not scan.is_partial for scan in clean[-3:]) >= 2, "the stream comes back as soon as the noise ends"


def test_a_node_without_checksum_spoils_at_most_itself() -> None:
    stream = _stream("rplidar-0x81")
    rng = np.random.default_rng(3)
    data = np.frombuffer(stream.data * 5, np.uint8).copy()
    flipped = rng.random(len(data)) < 0.005
    data[flipped] ^= rng.integers(1, 256, int(flipped.sum())).astype(np.uint8)
    dropped = rng.random(len(data)) < 0.005
    scans = decode(stream, stream.prefix + data[~dropped].tobytes(), chunk=4096)
    n_wrong = sum(int((np.nan_to_num(errors_m(scan.angles_rad, scan.ranges_m)) > 0.05).sum()) for scan in scans)
    assert n_wrong <= int(flipped.sum() + dropped.sum())
