"""`mapquilt devices`, `scan` and `record`, on an LD06 behind a real pty."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import pytest

from agent.cli import main
from hw.recorder import read_recording
from tests.harness.serial_device import SerialDevice
from tests.harness.waiting import until


@pytest.fixture
def lidar(tmp_path: Path) -> Iterator[SerialDevice]:
    with SerialDevice("ld06", tmp_path / "lidar") as lidar:
        yield lidar


def test_scan_tells_figures_and_draws_what_it_sees(
    lidar: SerialDevice, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    picture = tmp_path / "scan.png"
    assert main(["scan", f"ld06:{lidar.link}", "-n", "3", "--json", "--png", str(picture)]) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert len(lines) == 3
    assert lines[-1]["points"] == 450 and lines[-1]["valid"] == 450 and not lines[-1]["is_partial"]
    assert (lines[-1]["nearest_m"], sum(lines[-1]["histogram"])) == (1.1, 450)  # it stands 1.1 m from the lower wall
    image = cv2.imread(str(picture))
    assert image.shape == (800, 800, 3)
    middle = image[400, 400].tolist()
    assert middle[2] > 150 and middle[1] < 90, "the sensor is drawn red in the middle"
    assert (image.min(axis=2) < 60).sum() > 400, "walls are drawn dark"


def test_a_person_gets_one_line_a_second(lidar: SerialDevice, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scan", f"ld06:{lidar.link}", "-n", "3"]) == 0
    out = capsys.readouterr().out
    assert "LD06" in out and "450 points" in out and "100% of the circle" in out


def test_scan_tells_where_wheels_say_they_are(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with SerialDevice("kobuki", tmp_path / "base") as base:
        assert main(["scan", f"kobuki:{base.link}", "-n", "30", "--json"]) == 0
        last = json.loads(capsys.readouterr().out.splitlines()[-1])
        assert last["x_m"] > 0.05 and last["way_m"] == pytest.approx(last["x_m"], rel=0.02) and last["jumps"] == 0
        assert main(["scan", f"kobuki:{base.link}", "-n", "1"]) == 0
        assert "0 jumps" in capsys.readouterr().out
        assert main(["scan", f"kobuki:{base.link}", "--png", str(tmp_path / "x.png")]) == 2


def test_record_and_replay(lidar: SerialDevice, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "a.rec"
    assert main(["record", f"ld06:{lidar.link}", str(file), "--seconds", "1.2"]) == 0
    assert "readings" in capsys.readouterr().err
    assert main(["scan", f"replay:{file}?speed=5", "--json"]) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert len(lines) >= 4 and lines[0]["points"] == 450


def test_record_says_what_it_waits_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("agent.commands.record.START_S", 0.5)
    assert main(["record", f"ld06:{tmp_path}/none", str(tmp_path / "a.rec"), "--seconds", "0.1"]) == 1
    assert capsys.readouterr().err.startswith(f"waiting: ld06:{tmp_path}/none: no such port")


def test_devices_says_who_answers(lidar: SerialDevice, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["devices", "--probe", "--json", "--as", "ld06", str(lidar.link)]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found[0]["url"], found[0]["kind"], found[0]["model"]) == (f"ld06:{lidar.link}", "lidar", "LD06")
    assert main(["devices", "--probe", "--as", "xv11", str(lidar.link)]) == 1
    assert "nobody we know answers" in capsys.readouterr().out


def test_a_probe_for_what_cannot_be_found_ends_at_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["devices", "--probe", "--as", "ld07", str(tmp_path)]) == 2
    assert "no such kind; there are" in capsys.readouterr().err
    assert main(["devices", "--probe", f"{tmp_path}/none"]) == 1
    assert "none: no such port" in capsys.readouterr().err


def test_what_cannot_work_is_said_in_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scan", "ld07:/dev/ttyUSB0"]) == 2
    assert "is no kind of lidar" in capsys.readouterr().err
    assert main(["scan", f"ld06:{tmp_path}/none", "--seconds", "0.3"]) == 1
    assert "no such port" in capsys.readouterr().err
    assert main(["record", f"ld06:{tmp_path}/none", f"{tmp_path}/no/such/folder"]) == 2
    assert "cannot be written" in capsys.readouterr().err


def test_a_recording_is_not_lost_to_a_device_that_does_not_answer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("agent.commands.record.START_S", 0.1)
    (tmp_path / "a.rec").write_bytes(b"precious")
    assert main(["record", f"ld06:{tmp_path}/none", str(tmp_path / "a.rec"), "--seconds", "0.1"]) == 1
    assert (tmp_path / "a.rec").read_bytes() == b"precious"


def test_a_full_disk_ends_a_recording_in_one_sentence(lidar: SerialDevice, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["record", f"ld06:{lidar.link}", "/dev/full"]) == 3
    assert "No space left on device" in capsys.readouterr().err


def test_sigterm_finishes_a_recording(lidar: SerialDevice, tmp_path: Path) -> None:
    words = [sys.executable, "-m", "agent", "record", f"ld06:{lidar.link}", str(tmp_path / "a.rec")]
    process = subprocess.Popen(words)
    try:
        until(lambda: os.path.exists(tmp_path / "a.rec") and os.path.getsize(tmp_path / "a.rec") > 100, 20.0, "bytes")
        process.terminate()
        assert process.wait(timeout=10) == 143
    finally:
        process.kill()
    assert read_recording(tmp_path / "a.rec").records


def test_a_recording_of_wheels_is_shown_as_wheels(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with SerialDevice("wt1", tmp_path / "base") as base:
        assert main(["record", f"wheels:{base.link}", str(tmp_path / "w.rec"), "--seconds", "0.5"]) == 0
    assert main(["scan", f"replay:{tmp_path / 'w.rec'}", "--json"]) == 0
    assert "heading_deg" in capsys.readouterr().out
    assert main(["map", str(tmp_path / "w.rec")]) == 4
    assert "replay:FILE" in capsys.readouterr().err


def test_what_has_no_bytes_cannot_be_recorded(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["record", "sim:office", str(tmp_path / "a.rec")]) == 2
    assert "mapquilt sim" in capsys.readouterr().err


def test_a_file_is_no_serial_port(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "f").write_text("")
    for path in (tmp_path, tmp_path / "f"):
        assert main(["scan", f"ld06:{path}", "--seconds", "0.2"]) == 1
        assert f"{path}: no serial port" in capsys.readouterr().err


def test_no_port_is_an_empty_array(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("agent.commands.devices.serial_ports", list)
    assert main(["devices", "--json"]) == 1
    assert json.loads(capsys.readouterr().out) == []
