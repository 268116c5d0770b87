"""Status and the words to a running robot, over a real control socket."""

from __future__ import annotations

import json
import socket
from collections.abc import Callable
from pathlib import Path

import pytest

from agent.commands.status import duration, status_text
from tests.agent.commands.conftest import STATUS, FakeRobot, Run

StartRobot = Callable[..., FakeRobot]


def test_a_status_tells_the_robot_in_a_few_lines(run: Run, robot: StartRobot) -> None:
    robot("r1")
    ended = run("status")
    assert (ended.code, ended.err) == (0, "")
    assert ended.out.splitlines() == [
        "r1  up 1 h 2 min",
        "  mapping  tracking, 82 m2 known, 120 scans (1 lost), 2.3 ms CPU each",
        "  lidar    running 10.0 Hz, 450 points, LD06, ld06:/dev/ttyUSB0",
        "  fleet    mapquilt: one map with r2; 1 link, lan, shared",
        "  fleet    sent 2.0 KB, received 0.5 KB",
        "  peer     r2 alive 0.2 s ago, merged for 2 min 5 s, match factor 0.961, 3 attempts",
        "  peer     r3?[2J lost 45.0 s ago, no, 1 attempt (little common wall)",
        "  together 130 m2 of r1, r2; 12 cells conflict and are unknown",
        "  merging  4.2 s from hearing a peer to fitting its map",
        "           ! wheels wheels:/dev/ttyACM0: no such port",
    ]


def test_a_second_look_shows_rates() -> None:
    later = {**STATUS, "uptime_s": STATUS["uptime_s"] + 2.0, "network": {**STATUS["network"], "served_bytes": 3072}}
    assert "sending 1024 B/s, receiving 0 B/s" in status_text(later, STATUS)


def test_a_robot_without_a_map_has_a_status(run: Run, robot: StartRobot) -> None:
    robot(
        "r1",
        mapping={"scans": 0, "scans_lost": 0, "odometry": 0, "cpu_ms_per_scan": None},
        peers=[],
        devices=[],
        problems=[],
        group=[],
    )
    out = run("status").out
    assert "waiting for the first scan" in out
    assert "alone so far; 1 link" in out


def test_a_robot_that_meets_nobody_says_why(run: Run, robot: StartRobot) -> None:
    robot("r1", peers=[], group=[], network={**STATUS["network"], "profile": "loopback", "links": []})
    assert "--profile lan finds others" in run("status").out


def test_json_is_one_object_a_line_and_robot(run: Run, robot: StartRobot) -> None:
    robot("r1")
    robot("r2")
    objects = [json.loads(line) for line in run("status", "--json").out.splitlines()]
    assert [status["robot"] for status in objects] == ["r1", "r2"]
    assert json.loads(run("status", "--json", "--robot", "r2").out)["robot"] == "r2"


def test_the_robot_of_a_service_is_found(run: Run, robot: StartRobot, tmp_path: Path) -> None:
    robot("r9", folder=tmp_path / "services" / "r9")
    assert run("status").out.startswith("r9 ")


def test_without_a_robot_there_is_a_sentence(run: Run, robot: StartRobot) -> None:
    ended = run("status")
    assert (ended.code, ended.out) == (5, "")
    assert "no robot runs here under this user; start one with mapquilt run" in ended.err
    robot("r1")
    ended = run("pause", "--robot", "r7")
    assert ended.code == 5
    assert "no robot 'r7' runs here under this user (running here: r1)" in ended.err


def test_a_crashed_robot_does_not_answer(run: Run, robot: StartRobot) -> None:
    crashed = robot("r1")
    crashed.server.close()
    with socket.socket(socket.AF_UNIX) as nobody:
        nobody.bind(str(crashed.server.path))
    ended = run("status", "--json")
    assert ended.code == 5
    assert "r1 ended without a word and does not answer; start one" in ended.err
    assert json.loads(ended.out)["exit_code"] == 5


def test_a_crashed_robot_does_not_hide_the_others(run: Run, robot: StartRobot) -> None:
    crashed, _ = robot("r1"), robot("r2")
    crashed.server.close()
    with socket.socket(socket.AF_UNIX) as nobody:
        nobody.bind(str(crashed.server.path))
    assert run("status").out.startswith("r2  up")
    assert run("pause").code == 0


def test_watching_goes_on_while_a_robot_starts_again(run: Run, robot: StartRobot, monkeypatch: pytest.MonkeyPatch) -> None:
    def stop() -> None:
        raise KeyboardInterrupt

    meanwhile = [robot("r1").server.close, lambda: robot("r1"), stop]
    monkeypatch.setattr("agent.commands.status.time.sleep", lambda _: meanwhile.pop(0)())
    ended = run("status", "--watch")
    assert ended.code == 130
    assert ended.out.count("r1  up") == 2
    assert ended.err.startswith("no robot runs here")


def test_a_word_reaches_the_robot_that_is_meant(run: Run, robot: StartRobot) -> None:
    first = robot("r1")
    assert run("pause").out == "did pause\n"
    second = robot("r2")
    ended = run("reset")
    assert ended.code == 2
    assert "several robots run here; say which one with --robot: r1, r2" in ended.err
    assert run("unmerge", "r3", "--robot", "r2").code == 0
    assert first.heard == [{"command": "pause"}]
    assert second.heard == [{"command": "unmerge", "peer": "r3"}]


@pytest.mark.parametrize("word", ["pause", "resume", "reset", "save", "stop"])
def test_every_word_is_understood(word: str, run: Run, robot: StartRobot) -> None:
    robot("r1")
    assert run(word).out == f"did {word}\n"
    assert run(word, "--quiet").out == ""


def test_a_refusal_is_told(run: Run, robot: StartRobot) -> None:
    robot("r1")
    ended = run("unmerge", "nobody")
    assert (ended.code, ended.out) == (5, "")
    assert ended.err == "mapquilt: no peer 'nobody'; known are r2\n"
    assert run("unmerge").code == 2


def test_an_interval_that_makes_no_sense_is_refused(run: Run) -> None:
    for interval in ("0", "nan", "inf", "-1"):
        assert run("status", "--watch", "--interval", interval).code == 2


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.4, "0 s"), (59, "59 s"), (60, "1 min 0 s"), (3600, "1 h 0 min"), (90061, "1 d 1 h")]
)
def test_a_duration_has_two_units(seconds: float, text: str) -> None:
    assert duration(seconds) == text
