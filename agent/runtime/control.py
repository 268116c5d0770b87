"""The robot's own ear: a unix socket that only its owner may open (0600), one JSON line in, one JSON line out.

{"command": "status"}                          -> {"ok": true, "status": {...}}
{"command": "unmerge", "peer": "robot-2"}      -> {"ok": true, "message": "..."}
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import socket
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

log = logging.getLogger(__name__)

MAX_REQUEST_BYTES = 4096
MAX_REPLY_BYTES = 8 * 1024 * 1024
ACCEPT_AGAIN_S = 0.25
CLIENT_TIMEOUT_S = 2.0  # a client that says nothing does not hold the next one up for longer

Handler = Callable[[Mapping[str, Any]], Mapping[str, Any]]


class ControlError(Exception):
    """A running agent could not be asked, or refused."""


class ControlServer:
    """Answers one client at a time on a thread of its own."""

    def __init__(self, path: Path, handlers: Mapping[str, Handler]) -> None:
        self.path, self._handlers = path, handlers
        self._closed = threading.Event()
        self._socket: socket.socket | None = None
        self._client: socket.socket | None = None  # who is being answered
        self._thread = threading.Thread(target=self._serve, name="control", daemon=True)

    def start(self) -> None:
        if len(os.fsencode(self.path)) > 100:  # sun_path holds 108 bytes
            raise ControlError(f"{self.path}: too long for a unix socket; set XDG_RUNTIME_DIR to a shorter directory")
        try:
            self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            self._refuse_a_twin()
            self._socket = self._bound()
        except OSError as error:
            said = f"{self.path}: cannot be made ({error.strerror or error}); set XDG_RUNTIME_DIR to a directory of your own"
            raise ControlError(said) from error
        self._thread.start()

    def _bound(self) -> socket.socket:
        bound = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        previous = os.umask(0o177)
        try:
            bound.bind(str(self.path))
            bound.listen(8)
        except OSError:
            bound.close()
            raise
        finally:
            os.umask(previous)
        bound.settimeout(0.25)
        return bound

    def _refuse_a_twin(self) -> None:
        """A socket nobody answers is left over from a crash; one that answers is another agent with our name."""
        if self.path.exists():
            with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
                probe.settimeout(0.5)
                with contextlib.suppress(OSError):
                    probe.connect(str(self.path))
                    raise ControlError(f"{self.path}: an agent with this name already runs here; stop it or choose another --id")
            self.path.unlink(missing_ok=True)

    def close(self) -> None:
        self._closed.set()
        if self._client is not None:
            with contextlib.suppress(OSError):  # it may be gone
                self._client.shutdown(socket.SHUT_RD)  # who says nothing is not waited for; an answer still goes out
        if self._thread.is_alive():
            self._thread.join(CLIENT_TIMEOUT_S + 0.5)
        if self._socket is not None:
            self._socket.close()
            with contextlib.suppress(OSError):
                self.path.unlink(missing_ok=True)

    def _serve(self) -> None:
        assert self._socket is not None
        while not self._closed.is_set():
            try:
                client, _ = self._socket.accept()
            except TimeoutError:
                continue
            except OSError as error:  # no file handle is free: one may be, soon
                log.debug("control: %s", error)
                self._closed.wait(ACCEPT_AGAIN_S)
                continue
            self._client = client
            with client:
                try:
                    client.settimeout(CLIENT_TIMEOUT_S)
                    client.sendall(json.dumps(self._reply(read_line(client, MAX_REQUEST_BYTES))).encode() + b"\n")
                except (OSError, ControlError) as error:
                    log.debug("control: %s", error)

    def _reply(self, line: bytes) -> Mapping[str, Any]:
        try:
            request = json.loads(line)
            handler = self._handlers[request["command"]]
        except (ValueError, KeyError, TypeError):
            return {"ok": False, "message": f"say one of: {', '.join(sorted(self._handlers))}"}
        try:
            return {"ok": True, **handler(request)}
        except ControlError as error:
            return {"ok": False, "message": str(error)}
        except Exception as error:
            log.exception("control: %s failed", request["command"])
            return {"ok": False, "message": f"{type(error).__name__}: {error}"}


def read_line(connection: socket.socket, limit_bytes: int) -> bytes:
    data = b""
    while not data.endswith(b"\n"):
        part = connection.recv(65536)
        if not part:
            break
        data += part
        if len(data) > limit_bytes:
            raise ControlError(f"more than {limit_bytes} bytes in one line")
    return data


def ask(path: Path, command: str, **arguments: object) -> dict[str, Any]:
    """Ask a running agent; `ControlError` says what to try when it does not answer."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.settimeout(10.0)
        try:
            connection.connect(str(path))
            connection.sendall(json.dumps({"command": command, **arguments}).encode() + b"\n")
            reply = json.loads(read_line(connection, MAX_REPLY_BYTES))
        except FileNotFoundError as error:
            raise ControlError(f"{path}: no agent runs here under this name; start one with mapquilt run") from error
        except (OSError, ValueError) as error:
            raise ControlError(f"{path}: the agent does not answer ({error}); is it still running?") from error
    if not isinstance(reply, dict) or not reply.get("ok"):
        raise ControlError(str(reply.get("message", "refused")) if isinstance(reply, dict) else "not an answer")
    return reply
