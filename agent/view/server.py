"""The live page: one HTML file, a stream of events, and a PNG per map.  Read-only; on loopback unless told otherwise.

    GET /                     the page
    GET /events               text/event-stream: what the page draws, when it changes (agent/view/broadcast.py)
    GET /status.json          the whole status as JSON
    GET /map/<name>.png?v=N   one pixel a cell (agent/view/render.py, grid_png)
    GET /features/<name>.json the feature map of a map, in strokes (agent/view/page_facts.py)
    GET /metrics              Prometheus text

A page on the internet must not read a robot through a visitor's browser: requests with a foreign Host are refused, and the
policy forbids the page to load anything from elsewhere.
"""

from __future__ import annotations

import base64
import contextlib
import hashlib
import ipaddress
import json
import logging
import re
import socket
import threading
from collections.abc import Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from typing import Any, Protocol

from agent.view.broadcast import Broadcast
from agent.view.page_facts import features_json, page_facts
from agent.view.render import grid_png
from protocol.features import FeatureMap
from protocol.grid import OccupancyGrid
from protocol.names import ROBOT_ID

log = logging.getLogger(__name__)

MAX_CLIENTS = 32
REQUEST_TIMEOUT_S = 5.0  # a client that sends its request slowly is hung up on
NAME = f"({ROBOT_ID.pattern})"
MAP_PATH, FEATURES_PATH = re.compile(rf"/map/{NAME}\.png"), re.compile(rf"/features/{NAME}\.json")


class ViewSource(Protocol):
    """What the page shows: the agent, or a watcher."""

    def status(self) -> Mapping[str, Any]: ...  # JSON values only
    def grid(self, name: str) -> tuple[str, OccupancyGrid] | None: ...  # (version, grid) of "global" or of a robot
    def features(self, name: str) -> FeatureMap | None: ...  # of the same maps; a moment old is good enough
    def metrics(self) -> str: ...


class ViewServer:
    """Serves until closed.  `port` 0 lets the system choose."""

    def __init__(self, source: ViewSource, port: int, host: str = "127.0.0.1") -> None:
        self._http = _Http((host, port), source)
        self._thread = threading.Thread(target=self._http.serve_forever, kwargs={"poll_interval": 0.2}, name="view", daemon=True)

    @property
    def url(self) -> str:
        host, port = self._http.server_address[:2]
        return f"http://{host if isinstance(host, str) else host.decode()}:{port}/"

    def start(self) -> None:
        self._http.events.start()
        self._thread.start()

    def close(self) -> None:
        self._http.shutdown()
        self._http.events.close()
        self._http.server_close()


class _Http(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False
    allow_reuse_address = True

    def __init__(self, address: tuple[str, int], source: ViewSource) -> None:
        self.source = source
        self.events = Broadcast(lambda: page_facts(source.status()), self._let_go)
        self._handed_over: set[Any] = set()  # connections that their handler gave to the broadcast just now
        self.page = resources.files("agent.view").joinpath("index.html").read_bytes()
        self.policy = content_policy(self.page)
        self.pngs: dict[str, tuple[str, bytes]] = {}
        self._clients = threading.BoundedSemaphore(MAX_CLIENTS)
        super().__init__(address, _Handler)

    def process_request(self, request: Any, client_address: Any) -> None:
        if not self._clients.acquire(blocking=False):
            request.settimeout(0.2)
            with contextlib.suppress(OSError):
                request.sendall(
                    b"HTTP/1.1 503 Service Unavailable\r\nRetry-After: 5\r\nConnection: close\r\nContent-Length: 0\r\n\r\n"
                )
            self.shutdown_request(request)
            return
        super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            if request in self._handed_over:
                self._handed_over.discard(request)
            else:
                self._clients.release()

    def watch(self, request: Any) -> None:
        """Leave a connection to the broadcast."""
        self._handed_over.add(request)
        self.events.join(request)

    def shutdown_request(self, request: Any) -> None:
        if request not in self._handed_over:
            super().shutdown_request(request)

    def _let_go(self, request: Any) -> None:
        """The broadcast is done with a connection."""
        request.close()
        self._clients.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        log.debug("view: client %s", client_address, exc_info=True)

    def png_of(self, name: str) -> tuple[str, bytes] | None:
        """The map's picture, encoded once per version."""
        found = self.source.grid(name)
        if found is None:
            return None
        version, grid = found
        kept = self.pngs.get(name)
        if kept is None or kept[0] != version:
            if len(self.pngs) > 64:
                self.pngs.clear()
            kept = self.pngs[name] = (version, grid_png(grid))
        return kept


def content_policy(page: bytes) -> str:
    """Only the page's own inline script and style may run, by their hashes."""

    def hashes(tag: str) -> str:
        bodies = re.findall(rf"<{tag}>(.*?)</{tag}>".encode(), page, re.DOTALL)
        return " ".join(f"'sha256-{base64.b64encode(hashlib.sha256(body).digest()).decode()}'" for body in bodies)

    return (
        f"default-src 'none'; script-src {hashes('script')}; style-src {hashes('style')}; img-src 'self' data:; "
        "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )


def is_own_host(host: str) -> bool:
    """A Host header that names this machine directly: an address or localhost or a .local name, never a public name."""
    name = host.rsplit(":", 1)[0] if not host.endswith("]") else host
    name = name.strip("[]").lower()
    if name == "localhost" or name == socket.gethostname().lower() or name.endswith(".local"):
        return True
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


class _Handler(BaseHTTPRequestHandler):
    server: _Http
    server_version = "mapquilt"
    sys_version = ""
    timeout = REQUEST_TIMEOUT_S

    def do_GET(self) -> None:
        path = self.path.partition("?")[0]
        if not is_own_host(self.headers.get("Host", "")):
            self._send(HTTPStatus.FORBIDDEN, "text/plain", b"this page answers to its own address only\n")
        elif path == "/":
            self._send(HTTPStatus.OK, "text/html; charset=utf-8", self.server.page)
        elif path == "/events":
            self._head(HTTPStatus.OK, "text/event-stream", None)
            self.server.watch(self.connection)
        elif path == "/status.json":
            self._send(HTTPStatus.OK, "application/json", json.dumps(self.server.source.status()).encode())
        elif path == "/metrics":
            self._send(HTTPStatus.OK, "text/plain; version=0.0.4", self.server.source.metrics().encode())
        elif (match := MAP_PATH.fullmatch(path)) is not None and (picture := self.server.png_of(match[1])) is not None:
            self._send(HTTPStatus.OK, "image/png", picture[1])
        elif (match := FEATURES_PATH.fullmatch(path)) is not None and (
            features := self.server.source.features(match[1])
        ) is not None:
            self._send(HTTPStatus.OK, "application/json", json.dumps(features_json(features)).encode())
        else:
            self._send(HTTPStatus.NOT_FOUND, "text/plain", b"not here\n")

    def _send(self, status: HTTPStatus, kind: str, body: bytes) -> None:
        self._head(status, kind, len(body))
        self.wfile.write(body)

    def _head(self, status: HTTPStatus, kind: str, length: int | None) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        if length is not None:
            self.send_header("Content-Length", str(length))
        self.send_header("Cache-Control", "no-store")
        self.send_header("Content-Security-Policy", self.server.policy)
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Referrer-Policy", "no-referrer")
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.send_header("Connection", "close")
        self.end_headers()
        self.close_connection = True

    def log_message(self, format: str, *args: Any) -> None:
        log.debug("view: " + format, *args)


__all__ = ["ViewServer", "ViewSource", "content_policy", "is_own_host"]
