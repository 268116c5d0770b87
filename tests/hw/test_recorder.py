"""What a device said is kept to the byte, and said again as that device."""

from __future__ import annotations

from pathlib import Path

import pytest

from hw.device import open_lidar
from hw.errors import DeviceConfigError
from hw.readings import LaserScan
from hw.recorder import Recorder, read_recording
from tests.harness.lidar_streams import STREAMS, decode

STREAM = STREAMS["ld06"](seconds=1.0)


def _record(path: Path, url: str = "ld06:/dev/ttyUSB0", data: bytes = STREAM.data) -> Path:
    with Recorder(path, url) as recorder:
        for at in range(0, len(data), 500):
            recorder(50.0 + at / STREAM.bytes_per_s, data[at : at + 500])
    return path


def test_a_recording_reads_back_as_it_was_written(tmp_path: Path) -> None:
    recording = read_recording(_record(tmp_path / "a.rec"))
    assert recording.url == "ld06:/dev/ttyUSB0"
    assert b"".join(data for _, data in recording.records) == STREAM.data
    assert recording.seconds == pytest.approx(17500 / STREAM.bytes_per_s)


def test_a_recording_cut_off_is_good_up_to_there(tmp_path: Path) -> None:
    path = _record(tmp_path / "a.rec")
    path.write_bytes(path.read_bytes()[:5000])
    recording = read_recording(path)
    assert 8 <= len(recording.records) < 10
    assert STREAM.data.startswith(b"".join(data for _, data in recording.records))


def test_a_replay_shows_the_scans_the_device_saw(tmp_path: Path) -> None:
    path = _record(tmp_path / "a.rec")
    device = open_lidar(f"replay:{path}?speed=4").start()
    scans = []
    while (scan := device.read(1.0)) is not None:
        assert isinstance(scan, LaserScan)
        scans.append(scan)
    assert "the recording is at its end" in device.health().last_error
    device.stop()
    truth = decode(STREAM, STREAM.data)
    assert len(scans) >= 3
    assert all(scan.ranges_m.tobytes() == truth[0].ranges_m.tobytes() for scan in scans)


def test_a_pause_in_a_recording_is_waited_out(tmp_path: Path) -> None:
    """The description of an RPLIDAR's stream comes once, at its beginning: nothing may make the driver forget it."""
    stream = STREAMS["rplidar-0x85"](seconds=1.0)
    with Recorder(tmp_path / "a.rec", "rplidar:/dev/ttyUSB0") as recorder:
        recorder(50.0, stream.prefix + stream.data)
        recorder(51.0, stream.data)
    device = open_lidar(f"replay:{tmp_path / 'a.rec'}").start()
    scans = 0
    while device.read(3.0) is not None:
        scans += 1
    health = device.health()
    device.stop()
    assert "at its end" in health.last_error
    assert (health.stalls, health.dropped + scans) == (0, len(decode(stream, stream.prefix + 2 * stream.data)))


def test_an_endless_replay_goes_on(tmp_path: Path) -> None:
    device = open_lidar(f"replay:{_record(tmp_path / 'a.rec')}?speed=20&loop=1").start()
    try:
        for _ in range(25):
            assert device.read(2.0) is not None
    finally:
        device.stop()


def test_what_is_no_recording_is_refused(tmp_path: Path) -> None:
    (tmp_path / "x").write_bytes(b"FLASER 180 1.0")
    with pytest.raises(DeviceConfigError, match="is no recording"):
        open_lidar(f"replay:{tmp_path / 'x'}")
    with pytest.raises(DeviceConfigError, match="is no recording"):
        open_lidar("replay:/dev/zero")  # which has no end
    with pytest.raises(DeviceConfigError, match="cannot be read"):
        open_lidar(f"replay:{tmp_path / 'none'}")
    with pytest.raises(DeviceConfigError, match="is no kind of lidar"):
        open_lidar(f"replay:{_record(tmp_path / 'w', 'wheels:/dev/ttyACM0')}")
