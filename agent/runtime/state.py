"""What survives kill -9 and a power cut: named values on disk, two generations each, every one with its checksum.

    magic "mqst" | version u16 | length u64 | sha256 (32) | payload          <name>.<generation>.state

A value is written aside, flushed, renamed into place, and the directory is flushed; the older generation is deleted only
then.  A file that does not read as written is set aside as `*.bad` and the generation before it is used; one that cannot
be read at all, which may be the disk's fault, stays where it is.  State never keeps a robot from starting.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import logging
import os
import re
import struct
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO, TypeVar

log = logging.getLogger(__name__)
T = TypeVar("T")

HEADER = struct.Struct("<4sHQ32s")
MAGIC = b"mqst"
VERSION = 1
KEPT = 2
MAX_BYTES = 512 * 1024 * 1024


class StateTaken(Exception):
    """Another robot keeps its map in the same directory; says which, and what to do."""


@contextlib.contextmanager
def held(folder: Path | None) -> Iterator[None]:
    """The directory for this process alone, until it ends however that be; a disk that knows no locks holds nobody up."""
    with contextlib.ExitStack() as stack:
        if folder is not None:
            with contextlib.suppress(OSError):
                folder.mkdir(parents=True, exist_ok=True)
                lock = stack.enter_context((folder / "lock").open("ab"))
                _lock(lock, folder)
        yield


def _lock(lock: BinaryIO, folder: Path) -> None:
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise StateTaken(
            f"{folder}: another robot that runs keeps its map there; stop it, or choose another --id or --state-dir"
        ) from error


class StateDirectory:
    """One directory of one robot.  A disk that fails is told in `last_error`, never raised: mapping goes on in memory."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.last_error = ""
        self._turn = threading.Lock()  # the keeper saves now and then, the operator when it likes

    def save(self, name: str, payload: bytes) -> bool:
        try:
            with self._turn:
                self._save(name, payload)
        except OSError as error:
            self._failed(f"cannot save {name} in {self.folder}: {error}")
            return False
        if self.last_error:
            log.info("state: the disk works again in %s", self.folder)
        self.last_error = ""
        return True

    def _save(self, name: str, payload: bytes) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        generations = self._generations(name)
        newest = generations[0][0] if generations else 0
        self._write(self.folder / f"{name}.{newest + 1}.state", payload)
        for _, path in generations[KEPT - 1 :]:
            path.unlink(missing_ok=True)

    def load(self, name: str) -> bytes | None:
        """The newest generation that reads as written; None when there is none."""
        try:
            generations = _stubbornly(lambda: self._generations(name))
        except OSError as error:
            self._failed(f"cannot look into {self.folder}: {error}")
            return None
        for _, path in generations:
            try:
                return unpack(_stubbornly(path.read_bytes))
            except OSError as error:
                self._failed(f"cannot read {path}: {error}")
            except CorruptState as error:
                log.warning("state: %s is set aside: %s", path, error)
                with contextlib.suppress(OSError):
                    path.replace(path.with_suffix(".bad"))
        return None

    def _failed(self, what: str) -> None:
        if not self.last_error:
            log.warning("state: %s; goes on in memory", what)
        self.last_error = what

    def forget(self, name: str) -> None:
        """Delete every generation of a name."""
        try:
            with self._turn:
                for _, path in _stubbornly(lambda: self._generations(name)):
                    path.unlink(missing_ok=True)
        except OSError as error:
            self._failed(f"cannot delete {name} in {self.folder}: {error}")

    def _generations(self, name: str) -> list[tuple[int, Path]]:
        """(number, file), newest first."""
        pattern = re.compile(re.escape(name) + r"\.(\d{1,18})\.state")
        if not self.folder.is_dir():
            return []
        found = [(int(match[1]), path) for path in self.folder.iterdir() if (match := pattern.fullmatch(path.name))]
        return sorted(found, reverse=True)

    def _write(self, path: Path, payload: bytes) -> None:
        aside = path.with_suffix(".tmp")
        with aside.open("wb") as file:
            file.write(pack(payload))
            file.flush()
            os.fsync(file.fileno())
        aside.replace(path)
        directory = os.open(self.folder, os.O_RDONLY)
        try:
            os.fsync(directory)
        finally:
            os.close(directory)


def _stubbornly(action: Callable[[], T]) -> T:
    """A second try before a map is given up: no file handle was free, or a cable shook."""
    try:
        return action()
    except OSError:
        return action()


class CorruptState(Exception):
    """A state file does not read as it was written."""


def pack(payload: bytes) -> bytes:
    return HEADER.pack(MAGIC, VERSION, len(payload), hashlib.sha256(payload).digest()) + payload


def unpack(data: bytes) -> bytes:
    if len(data) < HEADER.size:
        raise CorruptState(f"{len(data)} bytes are less than a header")
    magic, version, length, digest = HEADER.unpack_from(data)
    payload = data[HEADER.size :]
    if magic != MAGIC or version != VERSION:
        raise CorruptState(f"magic {magic!r}, version {version}")
    if length != len(payload) or length > MAX_BYTES or hashlib.sha256(payload).digest() != digest:
        raise CorruptState(f"{len(payload)} of {length} bytes, checksum differs")
    return payload
