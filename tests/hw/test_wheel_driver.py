"""Ticks of a board become odometry, dated by the board's own clock."""

from __future__ import annotations

import pytest

from hw import create2, kobuki
from hw.device import build_driver
from hw.readings import Odometry
from hw.supervisor import Device
from hw.urls import parse_url
from hw.wheels import FLAG_BOOT, EncoderFrame, InfoFrame, encode
from tests.harness.talking_port import TalkingPort

URL = "wheels:/dev/ttyACM0?ticks=1000&radius=0.05&track=0.3"


def _frame(k: int, ticks: int, flags: int = 0) -> bytes:
    return encode(EncoderFrame(k % 256, 20_000 * k, ticks, ticks, flags))


def _odometry(driver, data: bytes, now_s: float) -> list[Odometry]:
    readings = driver.feed(data, now_s)
    assert all(isinstance(reading, Odometry) for reading in readings)
    return readings


def test_straight_motion_is_the_wheels_roll() -> None:
    driver = build_driver(parse_url(URL), "wheels")
    samples = [s for k in range(11) for s in _odometry(driver, _frame(k, 100 * k), 10 + 0.02 * k)]
    assert samples[0].is_discontinuity and not any(s.is_discontinuity for s in samples[1:])
    assert samples[-1].x_m == pytest.approx(2 * 3.14159265 * 0.05)
    assert samples[-1].theta_rad == 0.0


def test_samples_read_together_keep_the_times_at_which_they_were_taken() -> None:
    driver = build_driver(parse_url(URL), "wheels")
    for k in range(10):
        _odometry(driver, _frame(k, 0), 10 + 0.02 * k)
    burst = _odometry(driver, b"".join(_frame(k, 0) for k in range(10, 15)), 10.28)
    assert [s.stamp_s for s in burst] == pytest.approx([10.2, 10.22, 10.24, 10.26, 10.28], abs=1e-4)
    assert not any(s.is_discontinuity for s in burst)


def test_time_never_runs_backwards_when_the_first_sample_came_late() -> None:
    driver = build_driver(parse_url(URL), "wheels")
    late = _odometry(driver, _frame(0, 0), 10.5)
    on_time = [s for k in range(1, 8) for s in _odometry(driver, _frame(k, 0), 10.44 + 0.02 * k)]
    stamps = [s.stamp_s for s in late + on_time]
    assert stamps == sorted(stamps)
    assert not any(s.is_discontinuity for s in on_time)


def test_a_reboot_and_a_reopened_port_are_discontinuities() -> None:
    driver = build_driver(parse_url(URL), "wheels")
    for k in range(5):
        _odometry(driver, _frame(k, 50 * k), 10 + 0.02 * k)
    rebooted = _odometry(driver, _frame(0, 0, FLAG_BOOT), 10.4)
    assert [s.is_discontinuity for s in rebooted] == [True]
    driver.restart()
    assert [s.is_discontinuity for s in _odometry(driver, _frame(1, 0), 10.42)] == [True]


def test_a_board_that_tells_its_geometry_needs_no_options() -> None:
    driver = build_driver(parse_url("wheels:/dev/ttyACM0"), "wheels")
    assert _odometry(driver, _frame(0, 0), 10.0) == [], "what a tick is worth is not known yet"
    samples = _odometry(driver, encode(InfoFrame(1000, 50_000, 300_000, "base")) + _frame(1, 0) + _frame(2, 100), 10.04)
    assert samples[-1].x_m == pytest.approx(0.0314159265)


def test_a_base_that_only_answers_is_asked_from_the_first_moment() -> None:
    ticks = iter(range(0, 10**9, 5))

    def answer(port: TalkingPort, data: bytes) -> None:
        if data.endswith(b"e\r"):
            n = next(ticks)
            port.say(f"{n} {n}\r\n".encode())

    driver = build_driver(parse_url("arduino:/dev/x?ticks=1000&radius=0.05&track=0.3"), "wheels")
    device = Device("arduino:test", driver, TalkingPort(answer).open).start()
    try:
        samples = [device.read(5.0) for _ in range(20)]
        assert all(isinstance(sample, Odometry) for sample in samples)
        assert samples[-1].x_m > samples[1].x_m
    finally:
        device.stop()


@pytest.mark.parametrize(("url", "frame"), [
    (URL, _frame(1, 0)),
    ("create2:/dev/ttyUSB0", create2.encode_stream({43: 1, 44: 2})),
    ("kobuki:/dev/ttyUSB0", kobuki.encode(kobuki.Core(7, 1, 2).encode())),
])  # fmt: skip
def test_a_damaged_frame_is_told(url: str, frame: bytes) -> None:
    driver = build_driver(parse_url(url), "wheels")
    damaged = frame[:4] + bytes((frame[4] ^ 0x20,)) + frame[5:]
    assert len(_odometry(driver, frame + damaged + frame, 10.0)) == 2
    counters = driver.counters
    assert (counters.frames, counters.bad_frames, counters.skipped_bytes, counters.resyncs) == (2, 1, len(frame), 1)
    assert counters.bytes_in == 3 * len(frame)
