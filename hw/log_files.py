"""A log of text, line by line, plain or packed; what is no log is refused after its first bytes, however long it is."""

from __future__ import annotations

import bz2
import gzip
import lzma
import stat
import zlib
from collections.abc import Callable, Iterator
from io import BufferedIOBase
from pathlib import Path

from hw.errors import DeviceConfigError

MAX_LINE_BYTES = 100_000  # a thousand beams and what each reflected, six decimals
MAX_TEXT_BYTES = 1 << 30
HEAD_BYTES = 512
PACKED: dict[bytes, Callable[[Path], BufferedIOBase]] = {
    b"\x1f\x8b": gzip.GzipFile,
    b"BZh": bz2.BZ2File,
    b"\xfd7zXZ": lzma.LZMAFile,
}


def refuse_endless(path: Path) -> None:
    """DeviceConfigError for what is there but is no file: a device has no end, and a pipe may have no beginning."""
    try:
        found = path.stat()
    except FileNotFoundError as error:
        raise DeviceConfigError(f"{path}: no such recording") from error
    except (OSError, ValueError) as error:
        raise DeviceConfigError(f"{path}: cannot be read: {error}") from error
    if stat.S_ISDIR(found.st_mode):
        raise DeviceConfigError(f"{path}: a folder, no recording; name the file in it")
    if not stat.S_ISREG(found.st_mode):
        raise DeviceConfigError(f"{path}: no file but a device or a pipe; save the recording to a file first")


def text_lines(path: Path) -> Iterator[str]:
    """Every line; DeviceConfigError where it stops being text."""
    refuse_endless(path)
    number = 0
    try:
        with _opened(path) as stream:
            for number, line in enumerate(_bounded(stream, path), 1):  # noqa: B007  told when it breaks off
                yield line.decode("ascii", "replace")
    except EOFError as error:
        raise DeviceConfigError(
            f"{path}: cut short after {number} lines; copy it again, or unpack what is there: zcat FILE > FILE.log"
        ) from error
    except (OSError, zlib.error, lzma.LZMAError) as error:
        raise DeviceConfigError(f"{path}: cannot be read after {number} lines: {error}; copy it again") from error


def _opened(path: Path) -> BufferedIOBase:
    """By what the file begins with, whatever it is called."""
    with path.open("rb") as stream:
        head = stream.read(HEAD_BYTES)
    for magic, unpacked in PACKED.items():
        if head.startswith(magic):
            return unpacked(path)
    if head.startswith(b"PK\x03\x04"):
        raise DeviceConfigError(f"{path}: a zip archive; unpack it, and name the log in it")
    if b"\0" in head:
        raise DeviceConfigError(f"{path}: begins with {head[:8]!r}, which is no text; is this a CARMEN log?")
    if path.stat().st_size > MAX_TEXT_BYTES:
        raise DeviceConfigError(
            f"{path}: {path.stat().st_size} bytes; a log of up to {MAX_TEXT_BYTES} can be read; cut it in two"
        )
    return path.open("rb")


def _bounded(stream: BufferedIOBase, path: Path) -> Iterator[bytes]:
    size = 0
    while line := stream.readline(MAX_LINE_BYTES + 1):
        size += len(line)
        if len(line) > MAX_LINE_BYTES:
            raise DeviceConfigError(f"{path}: a line of more than {MAX_LINE_BYTES} characters; is this a CARMEN log?")
        if size > MAX_TEXT_BYTES:
            raise DeviceConfigError(f"{path}: more than {MAX_TEXT_BYTES} characters of text; cut it in two")
        yield line
