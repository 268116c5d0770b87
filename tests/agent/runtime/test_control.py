"""The control socket: private, patient with nobody, and clear about what it does not know."""

from __future__ import annotations

import contextlib
import socket
import stat
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from agent.runtime.control import CLIENT_TIMEOUT_S, ControlError, ControlServer, ask
from tests.harness.waiting import until


@pytest.fixture
def server(tmp_path: Path) -> Iterator[ControlServer]:
    def echo(request: Mapping[str, Any]) -> Mapping[str, Any]:
        return {"message": f"hello {request.get('peer')}"}

    def refuse(_: Mapping[str, Any]) -> Mapping[str, Any]:
        raise ControlError("nothing to undo")

    def bug(_: Mapping[str, Any]) -> Mapping[str, Any]:
        raise RuntimeError("bug")

    running = ControlServer(tmp_path / "r.sock", {"echo": echo, "refuse": refuse, "bug": bug})
    running.start()
    yield running
    running.close()


def test_a_command_is_answered(server: ControlServer) -> None:
    assert ask(server.path, "echo", peer="robot-2")["message"] == "hello robot-2"


def test_only_the_owner_may_open_the_socket(server: ControlServer) -> None:
    assert stat.S_IMODE(server.path.stat().st_mode) == 0o600


def test_refusals_and_bugs_are_sentences(server: ControlServer) -> None:
    for command, said in (
        ("refuse", "nothing to undo"),
        ("bug", "RuntimeError: bug"),
        ("dance", "say one of: bug, echo, refuse"),
    ):
        with pytest.raises(ControlError, match=said):
            ask(server.path, command)


@pytest.mark.parametrize("line", [b"\n", b"{}\n", b"[1]\n", b"\xff\xfe\n", b'{"command": ["status"]}\n', b"x" * 10_000 + b"\n"])
def test_nonsense_does_not_end_the_server(server: ControlServer, line: bytes) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
        client.connect(str(server.path))
        client.sendall(line)
        client.settimeout(5.0)
        with contextlib.suppress(ConnectionResetError):
            client.recv(100)
    assert ask(server.path, "echo", peer="x")["ok"]


def test_a_second_agent_of_the_same_name_is_refused(server: ControlServer) -> None:
    with pytest.raises(ControlError, match="already runs"):
        ControlServer(server.path, {}).start()


def test_a_socket_left_by_a_crash_is_taken_over(tmp_path: Path) -> None:
    path = tmp_path / "r.sock"
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as crashed:
        crashed.bind(str(path))
    server = ControlServer(path, {"status": lambda _: {}})
    server.start()
    assert ask(path, "status")["ok"]
    server.close()
    assert not path.exists()


def test_a_client_that_says_nothing_does_not_hold_up_the_end(server: ControlServer) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as silent:
        silent.connect(str(server.path))
        until(lambda: server._client is not None)
        started_s = time.monotonic()
        server.close()
        assert time.monotonic() - started_s < 0.5 * CLIENT_TIMEOUT_S


def test_no_agent_is_one_clear_sentence(tmp_path: Path) -> None:
    with pytest.raises(ControlError, match="start one with mapquilt run"):
        ask(tmp_path / "none.sock", "status")


def test_a_socket_that_cannot_be_made_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    server = ControlServer(tmp_path / "file" / "r.sock", {})
    with pytest.raises(ControlError, match="set XDG_RUNTIME_DIR"):
        server.start()
    server.close()
