"""What a host asks a SCIP 2.0 scanner to measure, and how it is refused what cannot be (SERIAL.md 4.3)."""

from __future__ import annotations

import re
from dataclasses import dataclass

_SCAN = re.compile(rb"[MG][DSE]")
_FIELDS = ((4, b"01"), (4, b"02"), (2, b"03"), (1, b"06"), (2, b"07"))  # first, last, cluster, skip, count; the fault of each
TOO_SHORT, TOO_LONG, PAST_THE_END, END_FIRST = b"0C", b"0D", b"04", b"05"
TAG_TOO_LONG, TAG_INVALID = b"0G", b"0H"
MOST_TAG = 16
_TAG = re.compile(rb"[A-Za-z0-9 ._+@]*")


@dataclass(frozen=True, slots=True)
class ScanRequest:
    """MD, MS, ME, GD, GS or GE with its parameters."""

    line: bytes  # as it came: it is echoed
    first: int
    last: int
    cluster: int
    skip: int = 0
    count: int = 0  # 0: for ever

    @property
    def is_stream(self) -> bool:
        """Asked for once, sent again and again."""
        return self.line[:1] == b"M"

    @property
    def kind(self) -> bytes:
        """D: three characters, S: two, E: with intensities."""
        return self.line[1:2]

    def echo(self, left: int | None) -> bytes:
        """The line as a scan repeats it: with how many are still to come, where they were counted."""
        command, semicolon, tag = self.line.partition(b";")
        return self.line if left is None else command[:-2] + b"%02d" % left + semicolon + tag


def tag_fault(line: bytes) -> bytes | None:
    """Why the tag behind a command is refused; None when it is not."""
    tag = line.partition(b";")[2]
    if len(tag) > MOST_TAG:
        return TAG_TOO_LONG
    return None if _TAG.fullmatch(tag) else TAG_INVALID


def scan_request(line: bytes, last_step: int) -> ScanRequest | bytes | None:
    """What is asked for, or the status with which that is refused; None when it is another command."""
    command = line.partition(b";")[0]
    if not _SCAN.match(command):
        return None
    numbers, rest = [], command[2:]
    fields = _FIELDS if command[:1] == b"M" else _FIELDS[:3]
    if len(rest) != sum(size for size, _ in fields):
        return TOO_SHORT if len(rest) < sum(size for size, _ in fields) else TOO_LONG
    for size, fault in fields:
        text, rest = rest[:size], rest[size:]
        if not text.isdigit():
            return fault
        numbers.append(int(text))
    first, last, cluster, *others = numbers
    if last > last_step:
        return PAST_THE_END
    return END_FIRST if last < first else ScanRequest(line, first, last, max(1, cluster), *others)
