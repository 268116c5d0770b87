"""Wheel bases: vectors, laws of the decoders, and what may become motion."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hw import arduino_bridge, create2, kobuki, roboclaw, wheels
from hw.odometry import BaseProtocol, TickIntegrator, TickSample, WheelGeometry, arc, tick_delta
from protocol.geometry import SE2

VECTORS: list[dict[str, Any]] = json.loads((Path(__file__).parent / "data" / "serial.json").read_text())
GEOMETRY = WheelGeometry(0.001, 0.3, 1.0)


def vector(device: str, name: str) -> tuple[bytes, Any]:
    found = next(v for v in VECTORS if v["device"] == device and v["name"] == name)
    return bytes.fromhex(found["hex"]), found["expect"]


def test_create2_stream_vectors() -> None:
    data, expect = vector("create2", "stream 43/44")
    assert create2.decode_stream(data) == {43: expect["left"], 44: expect["right"]}
    assert create2.encode_stream({43: expect["left"], 44: expect["right"]}) == data
    data, expect = vector("create2", "stream 29,13")
    assert create2.decode_stream(data) == {int(k): v for k, v in expect.items()}
    assert create2.encode_stream({29: 537, 13: 0}) == data


def test_kobuki_vectors() -> None:
    assert kobuki.base_control(100, 0) == vector("kobuki", "straight 100 mm/s")[0]
    assert kobuki.request_extra(11) == vector("kobuki", "request extra")[0]
    data, expect = vector("kobuki", "core feedback")
    core = kobuki.Core.decode(data[5:-1])
    assert core is not None
    assert (core.clock_ms, core.left_ticks, core.right_ticks) == (expect["ts"], expect["left"], expect["right"])
    assert core.battery_dv / 10 == expect["volts"]
    assert kobuki.encode(core.encode()) == data


def test_roboclaw_vectors() -> None:
    data, expect = vector("roboclaw", "GETENCODERS reply to 804e")
    assert roboclaw.encode_counts(0x80, expect["m1"], expect["m2"]) == data
    assert roboclaw.opened(0x80, roboclaw.READ_ENCODERS, data) == data[:-2]
    data, expect = vector("roboclaw", "GETM1ENC reply to 8010")
    body = roboclaw.opened(0x80, roboclaw.READ_M1, data)
    assert body == expect["count"].to_bytes(4, "big") + bytes((expect["status"],))
    assert roboclaw.write_command(0x80, roboclaw.RESET_ENCODERS) == vector("roboclaw", "reset encoders")[0]


def test_wt1_vector() -> None:
    data, expect = vector("wt1", "encoder frame")
    frame = wheels.decode(data[:-1])
    assert frame == wheels.EncoderFrame(expect["seq"], expect["t_us"], expect["left"], expect["right"], expect["flags"])
    assert wheels.encode(frame) == data


def test_wt1_info_frame_tells_the_geometry() -> None:
    info = wheels.InfoFrame(2048, 50_000, 300_000, "robot")
    assert wheels.decode(wheels.encode(info)[:-1]) == info
    assert info.geometry().metres_per_tick == pytest.approx(math.tau * 0.05 / 2048)


FRAMES: dict[str, tuple[Callable[[], BaseProtocol], Callable[[int, int], bytes]]] = {
    "wheels": (
        lambda: wheels.WheelBoard(GEOMETRY),
        lambda left, right: wheels.encode(wheels.EncoderFrame(left % 256, 7, left, right)),
    ),
    "create2": (create2.Create2, lambda left, right: create2.encode_stream({43: left, 44: right})),
    "kobuki": (kobuki.Kobuki, lambda left, right: kobuki.encode(kobuki.Core(7, left, right).encode())),
    "arduino": (
        lambda: arduino_bridge.ArduinoBridge(GEOMETRY),
        lambda left, right: arduino_bridge.LINES_TO_JUMP * arduino_bridge.encode_counts(left, right),
    ),
    "roboclaw": (lambda: roboclaw.RoboClaw(GEOMETRY), lambda left, right: roboclaw.encode_counts(0x80, left, right)),
}
COUNTS = [(1, 2), (19, 275), (43, 44), (0x13, 0xAA55), (1000, 60000)]


def ticks(samples: list[TickSample]) -> list[tuple[int, int]]:
    return [(s.left_ticks, s.right_ticks) for s in samples]


@pytest.mark.parametrize("base", FRAMES)
def test_frames_decode_whole_byte_by_byte_and_behind_garbage(base: str) -> None:
    make, encode = FRAMES[base]
    stream = b"".join(encode(*pair) for pair in COUNTS)
    assert ticks(make().feed(stream)) == COUNTS
    decoder = make()
    assert ticks([s for byte in stream for s in decoder.feed(bytes((byte,)))]) == COUNTS
    garbage = bytes(range(1, 14)) + (b"\n" if base == "arduino" else b"\0" if base == "wheels" else b"")
    assert ticks(make().feed(garbage + stream))[-len(COUNTS) :] == COUNTS


@pytest.mark.parametrize("base", sorted(FRAMES))
def test_no_bytes_can_upset_a_decoder_or_fill_its_memory(base: str) -> None:
    make, encode = FRAMES[base]
    rng = np.random.default_rng(5)
    decoder = make()
    for _ in range(300):
        noise = rng.integers(0, 256, rng.integers(1, 300), dtype=np.uint8).tobytes()
        decoder.feed(noise + encode(*COUNTS[0]))
    end = b"\n" if base == "arduino" else b"\0"
    assert ticks(decoder.feed(end * 400 + b"".join(encode(*c) for c in COUNTS)))[-1] == COUNTS[-1]


@pytest.mark.parametrize("base", ["create2", "kobuki", "roboclaw", "wheels"])
def test_a_flipped_bit_is_never_a_sample(base: str) -> None:
    make, encode = FRAMES[base]
    frame = encode(1000, 2000)
    for k in range(8 * len(frame) - (8 if base == "wheels" else 0)):  # WT1's last byte is the delimiter
        damaged = bytearray(frame)
        damaged[k // 8] ^= 1 << k % 8
        found = make().feed(bytes(damaged))
        assert all(pair == (1000, 2000) for pair in ticks(found))


@pytest.mark.parametrize(("before", "after", "bits", "delta"), [
    (65530, 10, 16, 16), (10, 65530, 16, -16), (65535, 0, 16, 1), (0, 65535, 16, -1),
    (2**31 - 1, -(2**31), 32, 1), (-(2**31), 2**31 - 1, 32, -1), (2**32 - 3, 4, 32, 7), (250, 3, 8, 9),
])  # fmt: skip
def test_counters_wrap_the_short_way(before: int, after: int, bits: int, delta: int) -> None:
    assert tick_delta(before, after, bits) == delta


def told(*lines: tuple[int, int]) -> list[tuple[int, int]]:
    """What an arduino bridge makes of these lines, some of them wrong."""
    base = arduino_bridge.ArduinoBridge(GEOMETRY)  # 15 ms are 10 ticks, 50 ms 50
    return ticks(base.feed(b"".join(arduino_bridge.encode_counts(*line) for line in lines)))


def test_a_line_without_a_checksum_counts_when_it_was_told_twice() -> None:
    start = 4 * [(1000, 2000)]
    assert told(*start, (1030, 2030), (1031, 2031)) == [(1000, 2000), (1031, 2031)]
    assert told(*start, (1020, 2020), (1021, 221), (1040, 2040), (1041, 2041)) == [(1000, 2000), (1041, 2041)], "a digit lost"
    assert told(*start, (100, 2000), (100, 2000), (1040, 2040), (1041, 2041)) == [(1000, 2000), (1041, 2041)], "from both lines"


def test_counters_of_an_arduino_that_restart_or_jump_are_believed_when_they_stay() -> None:
    base = arduino_bridge.ArduinoBridge(GEOMETRY)
    lines = [*[(1000, 2000)] * 4, *[(3, 5)] * 4, *[(9000, 9000)] * 4]
    samples = base.feed(b"".join(arduino_bridge.encode_counts(*line) for line in lines))
    assert [(*pair, s.is_reset) for pair, s in zip(ticks(samples), samples, strict=True)] == [
        (1000, 2000, False),
        (3, 5, True),
        (9000, 9000, False),
    ]


def test_an_arc_is_exact() -> None:
    quarter = arc(0.5 * math.pi * 0.85, 0.5 * math.pi * 1.15, 0.3)
    assert (quarter.x_m, quarter.y_m, quarter.theta_rad) == pytest.approx((1.0, 1.0, math.pi / 2))
    straight = arc(1.0, 1.0, 0.3)
    assert (straight.x_m, straight.y_m, straight.theta_rad) == pytest.approx((1.0, 0.0, 0.0))


def drive(samples: list[tuple[int, int, bool]], bits: int = 32, period_s: float = 0.02) -> tuple[SE2, int]:
    """Where the base is at the end, and how often its motion was not known."""
    integrator = TickIntegrator(GEOMETRY)
    pose = SE2.identity()
    for i, (left, right, is_reset) in enumerate(samples):
        odometry = integrator.add(TickSample(left % 2**bits, right % 2**bits, bits, is_reset=is_reset), i * period_s)
        pose = SE2(odometry.x_m, odometry.y_m, odometry.theta_rad)
    return pose, integrator.discontinuities


def test_driving_across_the_wrap_is_driving() -> None:
    pose, breaks = drive([(65500 + 10 * i, 65500 + 10 * i, False) for i in range(20)], bits=16)
    assert (pose.x_m, pose.y_m, breaks) == (pytest.approx(0.19), 0.0, 0)
    pose, breaks = drive([(40 - 10 * i, 40 - 10 * i, False) for i in range(20)], bits=16)
    assert (pose.x_m, breaks) == (pytest.approx(-0.19), 0)


@pytest.mark.parametrize("broken", [(50_000, 50_000, False), (0, 5000, False), (100, 100, True)])
def test_a_jump_or_a_reset_is_a_discontinuity_and_never_motion(broken: tuple[int, int, bool]) -> None:
    left, right, _ = broken
    after = [(left + 10 * i, right + 10 * i, False) for i in range(1, 6)]
    pose, breaks = drive([(10 * i, 10 * i, False) for i in range(5)] + [broken, *after])
    assert pose.x_m == pytest.approx(0.04 + 0.05)
    assert breaks == 1


def test_a_clock_that_runs_backwards_is_a_discontinuity() -> None:
    integrator = TickIntegrator(GEOMETRY)
    integrator.add(TickSample(0, 0, 32, clock_s=50.0, clock_period_s=65.536), 1.0)
    assert integrator.add(TickSample(5, 5, 32, clock_s=1.0, clock_period_s=65.536), 1.02).is_discontinuity
