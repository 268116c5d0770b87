"""What is given as a log, and is none, is refused after its first bytes."""

from __future__ import annotations

import bz2
import gzip
import lzma
import os
import tracemalloc
from pathlib import Path

import pytest

from hw.errors import DeviceConfigError
from hw.log_files import text_lines

TEXT = b"# a log\r\nODOM 1 2 3\n"


@pytest.mark.parametrize("pack", [bytes, gzip.compress, bz2.compress, lzma.compress])
def test_a_log_is_read_however_it_is_packed_and_called(pack: type, tmp_path: Path) -> None:
    (tmp_path / "a.gz").write_bytes(pack(TEXT))
    assert [line.split() for line in text_lines(tmp_path / "a.gz")] == [["#", "a", "log"], ["ODOM", "1", "2", "3"]]


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"\x7fELF\x02\0\0\0", "which is no text"),
        (b"PK\x03\x04 ...", "a zip archive; unpack it"),
        (gzip.compress(TEXT * 9999, mtime=0)[:-50], "cut short after"),
        (gzip.compress(TEXT, mtime=0)[:12] + b"xxxxxxxxxxxxxxxxxxxxxxx", "cannot be read after 0 lines"),
        (gzip.compress(bytes(1 << 22), mtime=0), "a line of more than 100000 characters"),
        (b"x" * 200_000, "a line of more than 100000 characters"),
    ],
)
def test_what_is_no_log_is_told(data: bytes, said: str, tmp_path: Path) -> None:
    (tmp_path / "a.log").write_bytes(data)
    with pytest.raises(DeviceConfigError, match=said):
        list(text_lines(tmp_path / "a.log"))


def test_what_has_no_end_is_not_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with (tmp_path / "sparse").open("wb") as stream:
        stream.write(TEXT * 100)
        stream.truncate(10 << 30)
    tracemalloc.start()
    for path, said in (
        (Path("/dev/zero"), "a device or a pipe"),
        (tmp_path / "pipe", "a device or a pipe"),
        (tmp_path, "a folder"),
        (tmp_path / "sparse", "10737418240 bytes"),
        (tmp_path / "none", "no such recording"),
    ):
        with pytest.raises(DeviceConfigError, match=said):
            list(text_lines(path))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1 << 20
