"""What stands between our words and the network: nothing (`open`, `mtls`), or the fleet's seal (`shared`)."""

from __future__ import annotations

import threading
from typing import Protocol

from agent.runtime.network import NetworkConfigError, NetworkSettings
from protocol.errors import LocalProtocolError, RemoteProtocolError
from protocol.security import ReplayWindow, Sealer, derive_key, open_seal


class Guard(Protocol):
    """Seals what we say and opens what others say; `open` raises `RemoteProtocolError` for what is not believed."""

    def seal(self, payload: bytes) -> bytes: ...
    def open(self, data: bytes, sender: str) -> bytes: ...


class OpenGuard:
    """No seal: whoever can reach the network can speak, or TLS has checked already who does."""

    def seal(self, payload: bytes) -> bytes:
        return payload

    def open(self, data: bytes, sender: str) -> bytes:
        return data


class SharedGuard:
    """The fleet's secret: who does not know it is not heard, and an old recording is not heard twice."""

    def __init__(self, key: bytes, robot: str, boot: int) -> None:
        self._key = key
        self._sealer, self._window = Sealer(key, robot, boot), ReplayWindow()
        self._turn = threading.Lock()  # the fleet worker speaks, the answering thread answers, the pullers listen

    def seal(self, payload: bytes) -> bytes:
        with self._turn:
            return self._sealer.seal(payload)

    def open(self, data: bytes, sender: str) -> bytes:
        with self._turn:
            sealed = open_seal(self._key, self._window, data)
        if sealed.sender != sender:
            raise RemoteProtocolError(f"sealed by {sealed.sender}, said in the name of {sender}")
        return sealed.payload


def guard_for(settings: NetworkSettings, boot: int) -> Guard:
    if settings.security != "shared":
        return OpenGuard()
    path = settings.key_file
    assert path is not None  # `NetworkSettings.checked` has seen to it
    try:
        mode, secret = path.stat().st_mode, path.read_text().strip()
    except (OSError, UnicodeDecodeError) as error:
        raise NetworkConfigError(f"{path}: no readable key of the fleet ({error}); mapquilt fleet init makes one") from error
    if mode & 0o027:  # the group may read: the service's user exists only while it runs, so its group holds the key
        raise NetworkConfigError(f"{path}: others on this machine may read the fleet's key; chmod 600 {path}")
    try:
        return SharedGuard(derive_key(secret, settings.fleet), settings.robot, boot)
    except LocalProtocolError as error:
        raise NetworkConfigError(f"{path}: {error}") from error
