"""A disk on which the N-th call fails, once or from then on: open, read, write, flush, fsync, rename and the rest.

    with FailingDisk(folder) as disk:
        disk.fail(7, errno.ENOSPC, for_ever=True)
        ...                                         # everything below `folder` meets the fault, nothing else does
        disk.heal()

Only the calls this house makes are replaced: those of `io.open`, of the files it gives, and of `os`.
"""

from __future__ import annotations

import contextlib
import io
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any
from unittest import mock

CALLS = ("open", "fsync", "replace", "rename", "unlink", "mkdir", "listdir", "scandir")  # of os
FILE_CALLS = ("read", "write", "flush", "readline")


class FailingDisk:
    """Counts the calls on files below `folder`, and lets chosen ones fail."""

    def __init__(self, folder: Path) -> None:
        self.calls = 0
        self.failures = 0
        self.failed: list[str] = []  # what failed
        self._folder = os.fspath(folder)
        self._first, self._error, self._for_ever = 0, 0, False
        self._is_watching = True
        self._patches: list[Any] = []

    def fail(self, number: int, error: int, *, for_ever: bool) -> None:
        """The call `number` from now, counted from 1, fails with this errno; so do all after it when `for_ever`."""
        self._first, self._error, self._for_ever = self.calls + number, error, for_ever

    def heal(self) -> None:
        """Nothing fails any more."""
        self._first = 0

    @contextlib.contextmanager
    def unwatched(self) -> Iterator[None]:
        """For looking at what is there."""
        self._is_watching = False
        yield
        self._is_watching = True

    def __enter__(self) -> FailingDisk:
        replaced = {name: self._watched(name, getattr(os, name)) for name in CALLS}
        self._patches = [mock.patch.multiple(os, **replaced), mock.patch.object(io, "open", self._open(io.open))]
        for patch in self._patches:
            patch.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        for patch in reversed(self._patches):
            patch.stop()

    def count(self, call: str) -> None:
        """One more call; it fails when its number is up."""
        if not self._is_watching:
            return
        self.calls += 1
        if self._first and (self.calls == self._first or (self._for_ever and self.calls > self._first)):
            self.failures += 1
            self.failed.append(call)
            raise OSError(self._error, os.strerror(self._error))

    def _is_below(self, place: object) -> bool:
        return isinstance(place, int) or (isinstance(place, str | os.PathLike) and os.fspath(place).startswith(self._folder))

    def _watched(self, name: str, call: Callable[..., Any]) -> Callable[..., Any]:
        def watched(place: Any, *words: Any, **options: Any) -> Any:
            if self._is_below(place) and not (name == "mkdir" and os.path.isdir(place)):  # that one fails anyway
                self.count(name)
            return call(place, *words, **options)

        return watched

    def _open(self, call: Callable[..., Any]) -> Callable[..., Any]:
        def watched(place: Any, *words: Any, **options: Any) -> Any:
            if isinstance(place, int) or not self._is_below(place):
                return call(place, *words, **options)
            self.count("open")
            return FailingFile(call(place, *words, **options), self)

        return watched


class FailingFile:
    """An open file; a failing `write` has written half before, as a full disk does."""

    def __init__(self, file: Any, disk: FailingDisk) -> None:
        self._file, self._disk = file, disk

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._file, name)
        if name not in FILE_CALLS:
            return value

        def watched(*words: Any) -> Any:
            try:
                self._disk.count(name)
            except OSError:
                if name == "write":
                    self._file.write(words[0][: len(words[0]) // 2])
                raise
            return value(*words)

        return watched

    def __enter__(self) -> FailingFile:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()
