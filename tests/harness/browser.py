"""A real headless Chromium, spoken to over its DevTools protocol: a WebSocket client of sixty lines, and no package.

with Browser(1280, 800) as browser:
    browser.open("http://127.0.0.1:8080/")
    browser.until("document.title == 'mapquilt'")
"""

from __future__ import annotations

import base64
import contextlib
import json
import os
import shutil
import socket
import struct
import subprocess
import tempfile
import time
import urllib.request
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

START_WITHIN_S = 30.0
NAMES = ("chromium", "chromium-browser", "google-chrome")


def chromium() -> str | None:
    return next((path for name in NAMES if (path := shutil.which(name))), None)


class Browser:
    """One page of a fresh browser.  Use with `with`."""

    def __init__(self, width: int, height: int) -> None:
        self._stack = contextlib.ExitStack()
        self._size = (width, height)
        self._number = 0
        self.requests: list[str] = []  # every URL the page asked for
        self.errors: list[str] = []  # what its console complained about

    def __enter__(self) -> Browser:
        profile = Path(self._stack.enter_context(tempfile.TemporaryDirectory(prefix="mq-browser-", ignore_cleanup_errors=True)))
        program = chromium()
        assert program is not None
        words = ["--headless=new", "--no-sandbox", "--disable-gpu", "--remote-debugging-port=0", f"--user-data-dir={profile}"]
        size = f"--window-size={self._size[0]},{self._size[1]}"
        self._process = subprocess.Popen(
            [program, *words, size, "about:blank"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        self._stack.callback(self._end)
        self._connect(self._debugger(profile))
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.call(f"{domain}.enable")
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def _end(self) -> None:
        self._process.terminate()
        try:
            self._process.wait(5.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _debugger(self, profile: Path) -> str:
        """The WebSocket address of the first page."""
        deadline_s = time.monotonic() + START_WITHIN_S
        while time.monotonic() < deadline_s:
            with contextlib.suppress(OSError, ValueError, IndexError, StopIteration):  # the file is there before its first line
                port = (profile / "DevToolsActivePort").read_text().split()[0]
                with urllib.request.urlopen(f"http://127.0.0.1:{port}/json/list", timeout=2.0) as answer:
                    return str(next(page["webSocketDebuggerUrl"] for page in json.load(answer) if page["type"] == "page"))
            time.sleep(0.05)
        raise AssertionError(f"chromium did not start within {START_WITHIN_S:.0f} s")

    def _connect(self, url: str) -> None:
        parts = urlsplit(url)
        self._socket = self._stack.enter_context(socket.create_connection((parts.hostname, parts.port), timeout=20.0))
        key = base64.b64encode(os.urandom(16)).decode()
        head = f"GET {parts.path} HTTP/1.1\r\nHost: {parts.netloc}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        self._socket.sendall(f"{head}Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n\r\n".encode())
        self._stream = self._socket.makefile("rb")
        while self._stream.readline() not in (b"\r\n", b""):
            pass

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """One command and its answer; events that come meanwhile are noted."""
        self._number += 1
        payload = json.dumps({"id": self._number, "method": method, "params": parameters}).encode()
        mask, n = os.urandom(4), len(payload)
        head = b"\x81" + (bytes([0x80 | n]) if n < 126 else b"\xfe" + struct.pack(">H", n))
        self._socket.sendall(head + mask + bytes(byte ^ mask[i % 4] for i, byte in enumerate(payload)))
        while True:
            message = json.loads(self._frame())
            if message.get("id") == self._number:
                assert "error" not in message, message["error"]
                return dict(message["result"])
            self._note(message)

    def _frame(self) -> bytes:
        """One whole message; fragments are joined."""
        whole = b""
        while True:
            first, second = self._stream.read(2)
            length = second & 0x7F
            if length >= 126:
                length = int.from_bytes(self._stream.read(2 if length == 126 else 8), "big")
            whole += self._stream.read(length)
            if first & 0x80:
                return whole

    def _note(self, message: dict[str, Any]) -> None:
        parameters = message.get("params", {})
        if message.get("method") == "Network.requestWillBeSent":
            self.requests.append(parameters["request"]["url"])
        elif message.get("method") == "Runtime.exceptionThrown":
            self.errors.append(str(parameters["exceptionDetails"]))
        elif message.get("method") == "Log.entryAdded" and parameters["entry"]["level"] == "error":
            self.errors.append(str(parameters["entry"]))

    def open(self, url: str) -> None:
        self.call("Page.navigate", url=url)

    def run(self, expression: str) -> Any:
        """The value of a JavaScript expression on the page."""
        return self.call("Runtime.evaluate", expression=expression, returnByValue=True)["result"].get("value")

    def until(self, expression: str, within_s: float = 15.0) -> None:
        deadline_s = time.monotonic() + within_s
        while not self.run(expression):
            assert time.monotonic() < deadline_s, f"{expression} did not come true; errors: {self.errors[-3:]}"
            time.sleep(0.05)

    def key(self, key: str) -> None:
        """Press and release a key."""
        text = {"text": "\r"} if key == "Enter" else {"text": key} if len(key) == 1 else {}
        self.call("Input.dispatchKeyEvent", type="keyDown", key=key, **text)
        self.call("Input.dispatchKeyEvent", type="keyUp", key=key)

    def dark(self, is_dark: bool) -> None:
        features = [{"name": "prefers-color-scheme", "value": "dark" if is_dark else "light"}]
        self.call("Emulation.setEmulatedMedia", features=features)

    def screenshot(self, path: Path) -> None:
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot")["data"]))
