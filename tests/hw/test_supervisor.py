"""A device is kept alive through stalls, pulled cables and garbage, and says what is wrong; on a real pty under pyserial."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from hw.device import open_lidar
from hw.driver import Reading
from hw.health import DeviceHealth, DeviceState
from hw.ld06 import Ld06
from hw.readings import Odometry
from hw.supervisor import Device
from tests.harness.lidar_streams import STREAMS
from tests.harness.serial_device import SerialDevice
from tests.harness.talking_port import TalkingPort


@pytest.fixture
def lidar(tmp_path: Path) -> Iterator[SerialDevice]:
    with SerialDevice("ld06", tmp_path / "lidar") as lidar:
        yield lidar


@pytest.fixture
def device(lidar: SerialDevice) -> Iterator[Device]:
    device = open_lidar(f"ld06:{lidar.link}")
    assert isinstance(device, Device)
    device.start()
    assert device.read(5.0) is not None
    yield device
    device.stop()


def _until(device: Device, holds: Callable[[DeviceHealth], bool], seconds: float = 5.0) -> float:
    """Seconds until it holds."""
    begin_s = time.monotonic()
    while time.monotonic() - begin_s < seconds:
        if holds(device.health()):
            return time.monotonic() - begin_s
        time.sleep(0.005)
    raise AssertionError(f"never: {device.health()}")


def _next_reading(device: Device, seconds: float = 5.0) -> float:
    """Seconds until a reading that came from now on; the device may hold two older ones."""
    begin_s, readings = time.monotonic(), device.health().readings
    _until(device, lambda h: h.readings > readings, seconds)
    return time.monotonic() - begin_s


def test_a_running_device_says_how_it_is(device: Device, lidar: SerialDevice) -> None:
    _until(device, lambda h: abs(h.rate_hz - 10.0) < 3.0 and abs(h.bytes_per_s - 17600) < 8800, 10.0)
    health = device.health()
    assert health.state is DeviceState.RUNNING
    assert (health.port, health.model, health.points, health.baud) == (str(lidar.link), "LD06", 450, 230400)
    assert health.coverage == pytest.approx(1.0, abs=0.01)


def test_a_stall_is_noticed_and_the_stream_is_taken_up_again(device: Device, lidar: SerialDevice) -> None:
    lidar.silence()
    noticed_s = _until(device, lambda h: h.stalls >= 1)
    assert noticed_s < 1.0  # 0.4 s on a quiet machine: tests/campaigns/serial_timing.py
    assert "stands still" in device.health().last_error
    _until(device, lambda h: h.stalls >= 2)  # it was opened anew in the meantime
    lidar.relieve()
    assert _next_reading(device) < 2.0
    _until(device, lambda h: h.state is DeviceState.RUNNING)


def test_a_pulled_cable_is_noticed_at_once_and_found_at_another_pts(device: Device, lidar: SerialDevice) -> None:
    lidar.pull()
    assert _until(device, lambda h: h.state is DeviceState.DISCONNECTED) < 0.5
    time_gone_s = _until(device, lambda h: "no such port" in h.last_error)
    assert time_gone_s < 1.0
    spare = os.openpty()  # so that the pty comes back under another number
    lidar.relieve()
    assert _next_reading(device) < 1.5
    assert device.health().reconnects >= 1
    for fd in spare:
        os.close(fd)


def test_a_device_that_is_not_there_yet_is_waited_for(tmp_path: Path) -> None:
    link = tmp_path / "later"
    device = open_lidar(f"ld06:{link}").start()
    assert isinstance(device, Device)
    try:
        assert device.read(0.3) is None
        assert device.health().last_error.startswith(f"ld06:{link}: no such port")
        with SerialDevice("ld06", link):
            assert device.read(3.0) is not None
    finally:
        device.stop()


def test_a_bad_line_is_degraded_and_said(device: Device, lidar: SerialDevice) -> None:
    lidar.wear(1 / 400)
    _until(device, lambda h: h.state is DeviceState.DEGRADED)
    _until(device, lambda h: "frames are damaged" in h.last_error)
    lidar.wear(0.0)
    _until(device, lambda h: h.state is DeviceState.RUNNING)


def test_another_device_on_the_port_is_told_from_a_silent_one(lidar: SerialDevice) -> None:
    device = open_lidar(f"xv11:{lidar.link}").start()
    assert isinstance(device, Device)
    try:
        _until(device, lambda h: "no valid frame" in h.last_error)
        assert "is this really that device?" in device.health().last_error
    finally:
        device.stop()


def test_stopping_is_prompt_in_every_state(lidar: SerialDevice, tmp_path: Path) -> None:
    for url, seconds in ((f"ld06:{lidar.link}", 0.4), (f"rplidar:{lidar.link}", 0.3), (f"ld06:{tmp_path}/none", 0.2)):
        device = open_lidar(url).start()
        device.read(seconds)
        begin_s = time.monotonic()
        device.stop()
        assert time.monotonic() - begin_s < 1.0
        assert device.health().state is DeviceState.DISCONNECTED


def test_a_second_opener_is_told_who_has_the_port(device: Device, lidar: SerialDevice) -> None:
    second = open_lidar(f"ld06:{lidar.link}").start()
    assert isinstance(second, Device)
    try:
        _until(second, lambda h: "another program has it open" in h.last_error)
        assert second.health().readings == 0
    finally:
        second.stop()


class _Ticks(Ld06):
    """A driver that makes an odometry sample of every byte."""

    def feed(self, data: bytes, now_s: float) -> list[Reading]:
        self.counters.frames += 1
        return [Odometry(now_s, float(byte), 0.0, 0.0, is_discontinuity=byte == 7) for byte in data]


def test_a_discontinuity_nobody_fetched_in_time_is_not_lost() -> None:
    port = TalkingPort()
    port.stream(bytes([7]) + bytes(range(100, 250)) * 5, 20000.0)
    device = Device("ticks:test", _Ticks(), port.open).start()
    try:
        _until(device, lambda h: h.dropped > 800)
        first = device.read(1.0)
        assert isinstance(first, Odometry)
        assert first.is_discontinuity
    finally:
        device.stop()


def test_only_the_newest_scans_are_kept(device: Device) -> None:
    _until(device, lambda h: h.dropped >= 3)
    newest_s = max(reading.stamp_s for reading in (device.read(0.0), device.read(0.0)) if reading is not None)
    assert time.monotonic() - newest_s < 0.6
    assert device.read(0.0) is None


class _Broken(Ld06):
    def feed(self, data: bytes, now_s: float) -> list[Reading]:
        raise ZeroDivisionError("a bug")


def test_a_bug_in_a_driver_is_said_and_survived(lidar: SerialDevice) -> None:
    port = TalkingPort()
    stream = STREAMS["ld06"](seconds=3.0)
    port.stream(stream.data, stream.bytes_per_s)
    device = Device("ld06:test", _Broken(), port.open).start()
    try:
        _until(device, lambda h: "please report" in h.last_error and h.reconnects >= 2)
    finally:
        device.stop()
