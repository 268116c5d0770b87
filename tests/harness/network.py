"""Cables that break on purpose: TCP proxies between robots, each with a mode that a test may change at any moment.

pass   bytes flow
cut    every connection is reset, new ones are refused: somebody pulled the plug
hole   connections stay open and nothing arrives any more: the silent death of a Wi-Fi link
slow   bytes flow late and slowly: `delay_s` each way, at most `bytes_per_s`
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Coroutine
from typing import Any, Literal, TypeVar

Mode = Literal["pass", "cut", "hole", "slow"]
T = TypeVar("T")


class Cable:
    """One proxied connection endpoint: dial `locator` instead of the target."""

    def __init__(self, target: str, mode: Mode = "pass") -> None:
        self.target = target  # tcp/127.0.0.1:PORT
        self.mode: Mode = mode
        self.delay_s = 0.05
        self.bytes_per_s = 8_000  # 64 kbit/s
        self.port = 0
        self._server: asyncio.Server | None = None
        self._writers: set[asyncio.StreamWriter] = set()
        self._holes = asyncio.Event()

    @property
    def locator(self) -> str:
        return f"tcp/127.0.0.1:{self.port}"

    async def lay(self) -> None:
        self._server = await asyncio.start_server(self._on_dial, "127.0.0.1", self.port)
        self.port = self._server.sockets[0].getsockname()[1]

    async def set(self, mode: Mode) -> None:
        self.mode = mode
        if mode == "cut":
            if self._server is not None:
                self._server.close()
                self._server = None
            self._reset()
        elif self._server is None:
            await self.lay()
        if mode == "pass" and self._holes.is_set():
            self._reset()  # what a hole swallowed is missing from the stream: no real network would deliver the rest
        if mode == "hole":
            self._holes.set()
        else:
            self._holes.clear()

    async def remove(self) -> None:
        await self.set("cut")

    def _reset(self) -> None:
        for writer in list(self._writers):
            writer.transport.abort()

    async def _on_dial(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        host, _, port = self.target.removeprefix("tcp/").rpartition(":")
        try:
            far_reader, far_writer = await asyncio.open_connection(host, int(port))
        except OSError:
            writer.transport.abort()
            return
        self._writers |= {writer, far_writer}
        try:
            await asyncio.gather(self._carry(reader, far_writer), self._carry(far_reader, writer))
        finally:
            for end in (writer, far_writer):
                end.transport.abort()
                self._writers.discard(end)

    async def _carry(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError, asyncio.IncompleteReadError):
            while data := await reader.read(16384):
                if self.mode == "hole":
                    continue
                if self.mode == "slow":
                    await asyncio.sleep(self.delay_s + len(data) / self.bytes_per_s)
                writer.write(data)
                await writer.drain()
        writer.transport.abort()


class Network:
    """Runs cables on a thread of its own.  Use with `with`."""

    def __init__(self) -> None:
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="cables", daemon=True)
        self.cables: list[Cable] = []

    def __enter__(self) -> Network:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        for cable in self.cables:
            self._run(cable.remove())
        self._run(_all_ended())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(5.0)
        self._loop.close()

    def cable(self, target: str) -> Cable:
        """A new cable that leads to `target`."""
        cable = Cable(target)
        self._run(cable.lay())
        self.cables.append(cable)
        return cable

    def set(self, cable: Cable, mode: Mode) -> None:
        self._run(cable.set(mode))

    def _run(self, work: Coroutine[Any, Any, T]) -> T:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result(10.0)


async def _all_ended() -> None:
    """What still carries bytes, or waits for a slow line, is told to stop, and has stopped."""
    others = asyncio.all_tasks() - {asyncio.current_task()}
    for task in others:
        task.cancel()
    await asyncio.gather(*others, return_exceptions=True)
