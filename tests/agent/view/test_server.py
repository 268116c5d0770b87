"""The live page: self-contained, read-only, bounded, and deaf to other sites."""

from __future__ import annotations

import contextlib
import http.client
import json
import re
import socket
from collections.abc import Iterator, Mapping
from importlib import resources
from typing import Any
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest

from agent.view import broadcast
from agent.view.server import MAX_CLIENTS, ViewServer, _Handler
from protocol.features import FeatureMap
from protocol.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

PAGE = resources.files("agent.view").joinpath("index.html").read_text()


class Source:
    """A robot with one small map."""

    def __init__(self) -> None:
        self.scans = 0

    def status(self) -> Mapping[str, Any]:
        return {"robot": "r1", "facts": {"scans": str(self.scans)}, "problems": [], "workers": ["secret"]}

    def grid(self, name: str) -> tuple[str, OccupancyGrid] | None:
        cells = np.array([[OCCUPIED, FREE, UNKNOWN], [FREE, FREE, FREE]], np.int8)
        return ("1.1", OccupancyGrid(cells, 0.05)) if name == "r1" else None

    def features(self, name: str) -> FeatureMap | None:
        lines = np.array([[1, 2, 0.5, 3, 0.01, 0.01]], np.float32)
        circles = np.array([[4, 5, 0.25, 0.01]], np.float32)
        return FeatureMap(lines=lines, circles=circles) if name == "r1" else None

    def metrics(self) -> str:
        return "mapquilt_scans_total 0\n"


class Ballast(Source):
    """A robot with very much to say."""

    def status(self) -> Mapping[str, Any]:
        return {"robot": "r1", "facts": {"scans": str(self.scans), "ballast": str(self.scans) * 400_000}}


@pytest.fixture
def server() -> Iterator[ViewServer]:
    running = ViewServer(Source(), 0)
    running.start()
    yield running
    running.close()


def get(
    server: ViewServer, path: str, host: str | None = None, method: str = "GET"
) -> tuple[int, http.client.HTTPMessage, bytes]:
    address = urlsplit(server.url)
    connection = http.client.HTTPConnection(address.hostname or "", address.port, timeout=5)
    with contextlib.closing(connection):
        connection.request(method, path, headers={"Host": host} if host else {})
        response = connection.getresponse()
        return response.status, response.headers, response.read()


def test_the_page_is_small_and_asks_nobody_else() -> None:
    assert len(PAGE.encode()) < 60_000
    assert not re.search(r"https?://", PAGE)
    assert '<link rel="stylesheet"' not in PAGE


def test_only_the_pages_own_script_and_style_may_run(server: ViewServer) -> None:
    _, headers, body = get(server, "/")
    policy = headers["Content-Security-Policy"]
    assert body.decode() == PAGE
    assert "default-src 'none'" in policy
    assert policy.count("sha256-") == 2
    assert "unsafe" not in policy
    assert not re.search(r"\son\w+=|style=", PAGE)  # inline handlers and styles would be blocked


def test_a_map_is_one_pixel_a_cell_with_north_up(server: ViewServer) -> None:
    status, headers, body = get(server, "/map/r1.png?v=1.1")
    assert (status, headers["Content-Type"]) == (200, "image/png")
    pixels = cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_UNCHANGED)
    assert pixels.tolist() == [[128, 128, 128], [255, 128, 0]]


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "127.0.0.1.evil.example", "localhost.evil.example", ""])
def test_a_foreign_host_is_refused(server: ViewServer, host: str) -> None:
    assert get(server, "/status.json", host=host or " ")[0] == 403


@pytest.mark.parametrize("host", ["localhost", "127.0.0.1:8080", "[::1]:8080", "192.168.1.7:8080", "robot-1.local:8080"])
def test_its_own_addresses_are_answered(server: ViewServer, host: str) -> None:
    assert json.loads(get(server, "/status.json", host=host)[2])["robot"] == "r1"


@pytest.mark.parametrize(
    "path", ["/map/../../etc/passwd.png", "/map/none.png", "/map/R1.png", "/nothing", "/index.html", "/map/.png"]
)
def test_nothing_else_is_there(server: ViewServer, path: str) -> None:
    assert get(server, path)[0] == 404


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "OPTIONS", "PATCH"])
def test_it_is_read_only(server: ViewServer, method: str) -> None:
    assert get(server, "/", method=method)[0] == 501


def test_the_features_of_a_map_come_in_strokes(server: ViewServer) -> None:
    strokes = json.loads(get(server, "/features/r1.json")[2])
    assert strokes == {"lines": [[1, 2, 0.5, 3]], "arcs": [[4, 5, 0.25, 0, 6.283]], "curves": []}
    assert get(server, "/features/none.json")[0] == 404


class Listener:
    """A viewer's event stream."""

    def __init__(self, server: ViewServer, stack: contextlib.ExitStack) -> None:
        address = urlsplit(server.url)
        self.socket = stack.enter_context(socket.create_connection((address.hostname, address.port), timeout=5))
        self.socket.sendall(b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n")
        self._lines = self.socket.makefile("rb")

    def next(self) -> dict[str, Any]:
        found = json.loads(next(line for line in self._lines if line.startswith(b"data: "))[6:])
        assert isinstance(found, dict)
        return found


def test_the_first_event_is_everything_and_the_next_what_changed() -> None:
    source = Source()
    server = ViewServer(source, 0)
    server.start()
    with contextlib.ExitStack() as stack:
        early = Listener(server, stack)
        everything = early.next()["full"]
        assert everything["facts"] == {"scans": "0"}
        assert "workers" not in everything
        source.scans = 7
        assert early.next() == {"part": {"facts": {"scans": "7"}}}
        assert Listener(server, stack).next()["full"]["facts"] == {"scans": "7"}  # who comes late has missed nothing
    server.close()


def scans(event: dict[str, Any]) -> int:
    """Of a full event or a part."""
    (told,) = event.values()
    return int(told["facts"]["scans"])


def test_a_viewer_that_does_not_read_holds_nobody_up_and_gets_everything_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(broadcast, "PERIOD_S", 0.02)
    source = Ballast()
    server = ViewServer(source, 0)
    server.start()
    with contextlib.ExitStack() as stack:
        asleep, awake = Listener(server, stack), Listener(server, stack)
        for source.scans in range(1, 16):  # far more than the kernel holds for the sleeper
            while scans(awake.next()) < source.scans:
                pass
        seen = [asleep.next()]
        while scans(seen[-1]) < source.scans:
            seen.append(asleep.next())
        assert "full" in seen[0]
        assert "full" in seen[-1]
        assert len(seen) < 16
    server.close()


def open_stream(server: ViewServer, stack: contextlib.ExitStack) -> None:
    """A client that listens to events, connected for sure."""
    address = urlsplit(server.url)
    client = stack.enter_context(socket.create_connection((address.hostname, address.port), timeout=5))
    client.sendall(b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n")
    assert client.recv(15) == b"HTTP/1.0 200 OK"


def test_clients_are_bounded(server: ViewServer) -> None:
    with contextlib.ExitStack() as stack:
        for _ in range(MAX_CLIENTS):
            open_stream(server, stack)
        assert get(server, "/status.json")[0] == 503


def test_a_client_that_never_finishes_its_request_is_hung_up_on(server: ViewServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_Handler, "timeout", 0.2)
    address = urlsplit(server.url)
    with socket.create_connection((address.hostname, address.port), timeout=5) as client:
        client.sendall(b"GET / HT")
        assert client.recv(100) == b""
