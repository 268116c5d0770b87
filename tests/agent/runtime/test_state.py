"""State on disk: what was saved comes back, what is broken is set aside, and nothing ever stops the start."""

from __future__ import annotations

import os
import threading
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path

import pytest

from agent.runtime.state import StateDirectory, StateTaken, held, pack, unpack


def test_the_newest_generation_comes_back_and_two_are_kept(tmp_path: Path) -> None:
    state = StateDirectory(tmp_path / "deep" / "robot-1")
    for number in range(5):
        assert state.save("map", f"map {number}".encode())
    assert state.load("map") == b"map 4"
    assert len(list(state.folder.glob("map.*.state"))) == 2


def test_a_corrupt_file_is_set_aside_and_the_generation_before_it_serves(tmp_path: Path) -> None:
    state = StateDirectory(tmp_path)
    state.save("map", b"good")
    state.save("map", b"better")
    newest = tmp_path / "map.2.state"
    newest.write_bytes(newest.read_bytes()[:-1] + b"X")
    assert state.load("map") == b"good"
    assert (tmp_path / "map.2.bad").exists()


def test_every_truncation_and_every_flipped_byte_is_noticed(tmp_path: Path) -> None:
    whole = pack(b"occupied cells")
    for end in range(len(whole)):
        (tmp_path / "map.1.state").write_bytes(whole[:end])
        assert StateDirectory(tmp_path).load("map") is None
    for i in range(len(whole)):
        broken = bytearray(whole)
        broken[i] ^= 0x40
        (tmp_path / "map.1.state").write_bytes(broken)
        assert StateDirectory(tmp_path).load("map") is None


def test_a_file_left_half_written_by_a_crash_is_ignored(tmp_path: Path) -> None:
    state = StateDirectory(tmp_path)
    state.save("map", b"whole")
    (tmp_path / "map.2.tmp").write_bytes(b"mqst half")
    assert state.load("map") == b"whole"
    assert state.save("map", b"next")
    assert state.load("map") == b"next"


def test_a_disk_that_fails_is_said_and_never_raises(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    state = StateDirectory(tmp_path)

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as broken:
        broken.setattr("os.fsync", full)
        assert not state.save("map", b"x")
        assert "No space" in state.last_error
    assert state.save("map", b"y")
    assert state.last_error == ""
    assert state.load("map") == b"y"


def test_two_threads_that_save_at_once_take_turns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The keeper saves now and then, the operator when it likes."""
    state, go = StateDirectory(tmp_path), threading.Event()
    monkeypatch.setattr(os, "fsync", lambda _: go.wait(10.0))
    with ThreadPoolExecutor() as pool:
        saves = [pool.submit(state.save, "mapper", payload) for payload in (b"first", b"second")]
        wait(saves, timeout=0.1)
        go.set()
    assert [save.result() for save in saves] == [True, True]
    assert {unpack(path.read_bytes()) for path in tmp_path.glob("*.state")} == {b"first", b"second"}


def test_names_do_not_mix(tmp_path: Path) -> None:
    state = StateDirectory(tmp_path)
    state.save("map", b"1")
    state.save("map-old", b"2")
    state.forget("map")
    assert state.load("map") is None
    assert state.load("map-old") == b"2"


def test_two_robots_do_not_keep_their_maps_in_one_directory(tmp_path: Path) -> None:
    with held(tmp_path / "r1"):
        with pytest.raises(StateTaken, match="--state-dir"), held(tmp_path / "r1"):
            pass
        with held(tmp_path / "r2"), held(None):
            pass
    with held(tmp_path / "r1"):
        pass


def test_a_directory_that_cannot_be_made_holds_no_robot_up(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with held(tmp_path / "file" / "r1"):
        pass
