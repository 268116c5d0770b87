"""SCIP 2.0, what Hokuyo scanners speak: lines of text with a 6-bit sum each (SERIAL.md 4).

    MD0000108001000 LF            the request, echoed
    99b LF                        status: data follows
    timestamp:4 sum LF            milliseconds, 24 bits, wraps after 4 h 39 m
    data:64 sum LF  ...  LF LF    6 bits a character above '0', three characters a distance in mm

A 6-bit sum lets one damaged line in 64 through, so a scan stands only when every one of its lines, their number and their
lengths are right.  Values below DMIN are no distances but say why there is none: invalid.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

BLOCK_BYTES = 64
MODES = ("MD", "MS", "ME", "GD", "GS", "GE")  # M: a stream, G: one scan; D: 3 characters, S: 2 (below 4.1 m), E: with intensities
RATES = (19200, 57600, 115200, 250000, 500000, 750000)  # of units with an RS-232 line; USB has none
SCAN_ECHO = re.compile(rb"(M[DSE]|G[DSE])(\d{4})(\d{4})(\d{2})(?:\d\d{2})?(?:;.{0,16})?$", re.DOTALL)


def line_sum(text: bytes) -> int:
    """The character behind a line: the low 6 bits of the sum of its bytes, above '0'."""
    return (sum(text) & 0x3F) + 0x30


def is_line_good(line: bytes, is_text: bool = True) -> bool:
    """Is the last character the sum of the others?  A `;` before it, at the end of a text, counts or not: both are met."""
    if len(line) < 2:
        return False
    body = line[:-1]
    return line_sum(body) == line[-1] or (is_text and body[-1:] == b";" and line_sum(body[:-1]) == line[-1])


def encode_value(value: int, characters: int) -> bytes:
    """A number as `characters` characters of 6 bits, the highest first."""
    return bytes((value >> 6 * k & 0x3F) + 0x30 for k in range(characters - 1, -1, -1))


def decode_value(text: bytes) -> int:
    """The number in these characters."""
    value = 0
    for character in text:
        value = value << 6 | (character - 0x30 & 0x3F)
    return value


def decode_values(text: bytes, characters: int) -> NDArray[np.int64]:
    """All numbers in a block of characters."""
    sixes = np.frombuffer(text, np.uint8).astype(np.int64).reshape(-1, characters) - 0x30 & 0x3F
    shifts = 6 * np.arange(characters - 1, -1, -1)
    values: NDArray[np.int64] = (sixes << shifts).sum(axis=1)
    return values


def encode_message(echo: bytes, status: bytes = b"00", texts: Sequence[bytes] = (), blocks: Sequence[bytes] = ()) -> bytes:
    """An answer of the sensor: the echo, the status, lines of text or of characters of 6 bits, with their sums."""
    out = bytearray(echo + b"\n" + status + bytes((line_sum(status),)) + b"\n")
    for text in texts:
        out += text + bytes((line_sum(text.removesuffix(b";")),)) + b"\n"  # the vendor's own sums leave the ; out
    for block in blocks:
        out += block + bytes((line_sum(block),)) + b"\n"  # here a ; is a number
    return bytes(out + b"\n")


def encode_scan(echo: bytes, clock_ms: int, distances_mm: Sequence[int], intensities: Sequence[int] | None = None) -> bytes:
    """A scan message: MD and GD (3 characters), MS and GS (2), ME and GE (3 and 3 with intensities)."""
    characters = 2 if echo[1:2] == b"S" else 3
    if intensities is None:
        data = b"".join(encode_value(mm, characters) for mm in distances_mm)
    else:
        data = b"".join(encode_value(mm, 3) + encode_value(i, 3) for mm, i in zip(distances_mm, intensities, strict=True))
    blocks = [data[at : at + BLOCK_BYTES] for at in range(0, len(data), BLOCK_BYTES)]
    return encode_message(echo, b"99" if echo[:1] == b"M" else b"00", blocks=[encode_value(clock_ms, 4), *blocks])


@dataclass(frozen=True, slots=True)
class Message:
    """One answer: echo, status and lines without their sums."""

    echo: bytes
    status: bytes
    lines: tuple[bytes, ...] = ()


def decode_message(block: bytes) -> Message | None:
    """The message in these lines (without the empty one that ends it), or None when a sum is wrong."""
    lines = block.split(b"\n")
    if len(lines) < 2 or not 2 <= len(lines[0]) <= 40 or len(lines[1]) != 3 or not is_line_good(lines[1]):
        return None
    is_text = SCAN_ECHO.match(lines[0]) is None
    if not all(is_line_good(line, is_text) for line in lines[2:]):
        return None
    return Message(lines[0], lines[1][:2], tuple(line[:-1] for line in lines[2:]))


@dataclass(frozen=True, slots=True)
class Parameters:
    """What PP answers."""

    model: str = "UTM-30LX"
    range_min_mm: int = 23
    range_max_mm: int = 60000
    steps_per_turn: int = 1440
    first_step: int = 0
    last_step: int = 1080
    front_step: int = 540
    rpm: int = 2400

    def lines(self) -> list[bytes]:
        """As PP sends them."""
        pairs = (
            ("MODL", self.model),
            ("DMIN", self.range_min_mm),
            ("DMAX", self.range_max_mm),
            ("ARES", self.steps_per_turn),
            ("AMIN", self.first_step),
            ("AMAX", self.last_step),
            ("AFRT", self.front_step),
            ("SCAN", self.rpm),
        )
        return [f"{key}:{value};".encode() for key, value in pairs]

    @staticmethod
    def parse(lines: Sequence[bytes]) -> Parameters | None:
        """What the lines say; None when one is missing or cannot be."""
        told = fields_of(lines)
        try:
            found = Parameters(
                told["MODL"], *(int(told[key]) for key in ("DMIN", "DMAX", "ARES", "AMIN", "AMAX", "AFRT", "SCAN"))
            )
        except (KeyError, ValueError):
            return None
        is_sane = 0 < found.steps_per_turn <= 16384 and 0 <= found.first_step < found.last_step <= found.steps_per_turn
        return found if is_sane and 0 < found.rpm < 100000 and 0 <= found.range_min_mm < found.range_max_mm else None


URG_04LX = Parameters("URG-04LX", 20, 5600, 1024, 44, 725, 384, 600)
UTM_30LX = Parameters()


def fields_of(lines: Sequence[bytes]) -> dict[str, str]:
    """`KEY:value;` lines as a dictionary."""
    pairs = (line.decode("ascii", "replace").rstrip(";").partition(":") for line in lines)
    return {key: value for key, colon, value in pairs if colon}


@dataclass(frozen=True, slots=True)
class ScanData:
    """A scan message understood: raw values, below DMIN an error code."""

    first_step: int
    cluster: int
    clock_ms: int
    values: NDArray[np.int64]
    intensities: NDArray[np.int64] | None = None
    most_mm: int = 2**18 - 1  # the highest that its characters can say stands for everything farther


def scan_of(message: Message) -> ScanData | None:
    """The scan in a message; None when it is another message, or its blocks do not fit its request."""
    match = SCAN_ECHO.match(message.echo)
    if match is None or message.status not in (b"99", b"00") or len(message.lines) < 2:
        return None
    first, last, cluster = int(match[2]), int(match[3]), max(1, int(match[4]))
    if last < first or len(message.lines[0]) != 4:
        return None
    n = (last - first) // cluster + 1
    characters = 2 if match[1][1:] == b"S" else 3
    words = 2 if match[1][1:] == b"E" else 1
    data = b"".join(message.lines[1:])
    is_full = all(len(line) == BLOCK_BYTES for line in message.lines[1:-1])
    if not is_full or len(data) != n * characters * words or any(c < 0x30 or c > 0x6F for c in set(data)):
        return None
    values = decode_values(data, characters)
    clock_ms = decode_value(message.lines[0])
    if words == 2:
        return ScanData(first, cluster, clock_ms, values[0::2], values[1::2])
    return ScanData(first, cluster, clock_ms, values, most_mm=2 ** (6 * characters) - 1)


def scan_command(mode: str, first_step: int, last_step: int, skip: int = 0) -> bytes:
    """The request for scans: streams go on for ever, with `skip` scans left out between two."""
    return f"{mode}{first_step:04d}{last_step:04d}01{f'{skip}00' if mode[0] == 'M' else ''}\n".encode()


def scan_bytes(mode: str, n_steps: int) -> int:
    """How long the message of one scan is."""
    n = n_steps * {"D": 3, "S": 2, "E": 6}[mode[1]]
    return n + 2 * -(-n // BLOCK_BYTES) + 30  # sums and line ends; echo, status, time stamp
