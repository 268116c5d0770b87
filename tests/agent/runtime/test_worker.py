"""Workers make progress or say that they do not."""

from __future__ import annotations

import logging
import socket
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from agent.runtime.health import Health, Notifier
from agent.runtime.sensing import MAX_SCANS_WAITING, Readings
from agent.runtime.worker import Worker
from hw.readings import LaserScan, Odometry
from tests.harness.waiting import until


def test_an_exception_is_counted_and_the_worker_goes_on(caplog: pytest.LogCaptureFixture) -> None:
    calls = []

    def step() -> None:
        calls.append(1)
        if len(calls) < 3:
            raise ValueError("bad day")

    worker = Worker("w", step, 5.0, "in", "out")
    with caplog.at_level(logging.ERROR):
        worker.start()
        until(lambda: len(calls) > 3)
        worker.ask_to_stop()
        assert worker.join(2.0)
    report = worker.report()
    assert report.errors == 2
    assert report.last_error == "ValueError: bad day"
    assert len([r for r in caplog.records if "worker=w" in r.message]) == 1  # the first time only


def test_a_worker_says_what_it_costs() -> None:
    worker = Worker("w", lambda: sum(range(100_000)) and None, 5.0, "in", "out")
    worker.start()
    until(lambda: worker.report().cpu_s > 0.02)
    worker.ask_to_stop()
    assert worker.join(2.0)


def test_a_worker_that_does_not_come_back_is_stuck_and_the_watchdog_hungry(tmp_path: Path) -> None:
    release = threading.Event()
    worker = Worker("w", lambda: release.wait(5.0) and None, 0.05, "in", "out")
    path = tmp_path / "notify"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(path))
        manager.settimeout(2.0)
        health = Health(lambda: [worker.report()], Notifier(str(path)))
        worker.start()
        assert health.look("fine")
        assert b"WATCHDOG=1" in manager.recv(1000)
        until(lambda: worker.report().is_stuck)
        assert not health.look("fine")
        said = manager.recv(1000)
        assert b"WATCHDOG" not in said
        assert b"stuck: w" in said
    release.set()
    worker.ask_to_stop()
    assert worker.join(2.0)


def scan(stamp_s: float) -> LaserScan:
    return LaserScan(stamp_s, np.ones(4, np.float32), np.zeros(4, np.float32), 0.1, 10.0, duration_s=0.1)


def test_a_slow_mapper_loses_the_oldest_scans_and_no_odometry() -> None:
    readings = Readings()
    for i in range(10):
        readings.put(scan(i))
        readings.put(Odometry(i + 0.5, 0, 0, 0))
    odometry, first = readings.take(0.0, 0.0)
    assert len(odometry) == 10
    assert first is not None
    assert first.stamp_s == 10 - MAX_SCANS_WAITING
    assert readings.scans_lost == 10 - MAX_SCANS_WAITING


def test_a_scan_waits_for_the_odometry_of_its_last_beam() -> None:
    readings = Readings()
    readings.put(Odometry(0.9, 0, 0, 0))
    readings.put(scan(1.0))
    late = threading.Timer(0.03, readings.put, (Odometry(1.2, 0, 0, 0),))
    late.start()
    odometry, first = readings.take(0.0, 5.0)
    late.join()
    assert first is not None
    assert [sample.stamp_s for sample in odometry] == [0.9, 1.2]


def test_a_robot_without_encoders_does_not_wait_for_odometry() -> None:
    readings = Readings()
    readings.put(scan(1.0))
    started = time.monotonic()
    assert readings.take(0.0, 5.0)[1] is not None
    assert time.monotonic() - started < 1.0
