"""Raw bytes of a device with the time each portion came, kept in a file and played again as a device: `replay:FILE`.

    MQREC1\\n  url\\n   then records   nanoseconds:u64 length:u32 bytes          little-endian, time since the first record

A replay feeds the very bytes to the very driver at the recorded pace (`speed=2` twice as fast, `speed=0` as fast as they
are read, `loop=1` for ever), so what a robot saw in the field is seen again on the desk.
"""

from __future__ import annotations

import errno
import os
import stat
import struct
import time
from collections.abc import Iterator
from dataclasses import dataclass
from io import FileIO
from pathlib import Path
from types import TracebackType

from hw.device import build_driver, register_scheme
from hw.errors import DeviceAbsent, DeviceConfigError
from hw.supervisor import Device
from hw.urls import DeviceUrl, parse_url

MAGIC = b"MQREC1\n"
MAX_URL_BYTES = 1024
MAX_RECORD_BYTES = 1 << 20
_RECORD = struct.Struct("<QI")


class Recorder:
    """Writes a recording; call it with the time and the bytes of each read.

    An older recording in the same file is replaced when the first bytes come, not before; a disk that is full ends the
    recording, and `failed` says so.
    """

    def __init__(self, path: Path, url: str) -> None:
        self.bytes_written = 0
        self.failed = ""
        self._head = MAGIC + url.encode() + b"\n"
        self._first_s: float | None = None
        try:
            self._file: FileIO = path.open("ab", buffering=0)
        except OSError as error:
            raise DeviceConfigError(f"{path}: cannot be written: {error.strerror}; choose another file") from error

    def __call__(self, now_s: float, data: bytes) -> None:
        """Keep one read."""
        if self.failed:
            return
        try:
            if self._first_s is None:
                self._first_s = now_s
                self._begin()
            self._put(_RECORD.pack(max(0, round((now_s - self._first_s) * 1e9)), len(data)) + data)
        except OSError as error:
            self.failed = error.strerror or str(error)
        else:
            self.bytes_written += len(data)

    def _begin(self) -> None:
        if stat.S_ISREG(os.fstat(self._file.fileno()).st_mode):
            self._file.truncate(0)
        self._put(self._head)

    def _put(self, data: bytes) -> None:
        if self._file.write(data) != len(data):  # the last bytes that a disk had room for
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def close(self) -> None:
        """Finish the file."""
        self._file.close()

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


@dataclass(frozen=True, slots=True)
class Recording:
    """A recording read back: the URL of the device, and (seconds since the first, bytes) of each read."""

    url: str
    records: tuple[tuple[float, bytes], ...]

    @property
    def seconds(self) -> float:
        """From the first read to the last."""
        return self.records[-1][0] if self.records else 0.0


def read_recording(path: Path) -> Recording:
    """Read a file; one that was cut off is good up to there."""
    try:
        with path.open("rb") as stream:
            data = stream.read(len(MAGIC) + 1)
            if data.startswith(MAGIC):  # what is none may have no end, as /dev/zero
                data += stream.read()
    except OSError as error:
        raise DeviceConfigError(f"{path}: cannot be read: {error.strerror}; is this the recording's name?") from error
    end = data.find(b"\n", len(MAGIC))
    if not data.startswith(MAGIC) or not 0 <= end <= len(MAGIC) + MAX_URL_BYTES:
        raise DeviceConfigError(f"{path}: begins with {data[:8]!r}, which is no recording; make one with `mapquilt record`")
    return Recording(data[len(MAGIC) : end].decode("utf-8", "replace"), tuple(_records(data, end + 1)))


def _records(data: bytes, at: int) -> Iterator[tuple[float, bytes]]:
    while at + _RECORD.size <= len(data):
        nanoseconds, length = _RECORD.unpack_from(data, at)
        at += _RECORD.size
        if length > MAX_RECORD_BYTES or at + length > len(data):
            return
        yield nanoseconds / 1e9, data[at : at + length]
        at += length


class ReplayPort:
    """A `Port` that says again what a device once said, and hears nothing."""

    def __init__(self, recording: Recording, speed: float = 1.0, is_endless: bool = False) -> None:
        self._recording, self._speed, self._is_endless = recording, speed, is_endless
        self._next = 0
        self._begin_s = time.monotonic()

    def read(self, timeout_s: float) -> bytes:
        """See `Port.read`; after the last byte the port is gone, unless it is endless."""
        records = self._recording.records
        if self._next >= len(records):
            if not self._is_endless or not records:
                raise DeviceAbsent("the recording is at its end")
            self._next, self._begin_s = 0, time.monotonic() + 0.01
        due_s = self._begin_s + records[self._next][0] / self._speed if self._speed else 0.0
        wait_s = due_s - time.monotonic()
        if wait_s > timeout_s:
            time.sleep(timeout_s)
            return b""
        if wait_s > 0:
            time.sleep(wait_s)
        self._next += 1
        return records[self._next - 1][1]

    def write(self, data: bytes) -> None:
        """Nobody listens."""

    def set_baud(self, baud: int) -> None:
        """No line, no rate."""

    def set_lines(self, dtr: bool | None, rts: bool | None) -> None:
        """No line, no modem lines."""

    def flush_input(self) -> None:
        """Nothing is buffered."""

    def wake(self) -> None:
        """A read returns soon by itself."""

    def close(self) -> None:
        """Nothing is open."""


def open_replay(url: DeviceUrl, kind: str) -> Device:
    """The device a `replay:` URL names; nothing is asked of it, it only speaks."""
    url.only(("speed", "loop"))
    recording = read_recording(Path(url.path))
    port = ReplayPort(recording, url.number("speed", 1.0, 0, 1000), url.integer("loop", 0, 0, 1) == 1)
    driver = build_driver(parse_url(recording.url), kind)
    return Device(url.text, driver, lambda *_: port, url.path, is_passive=True)


register_scheme("replay", open_replay)
