"""What a terminal can do, and a progress bar for one: no colours and no moving lines where nobody would see them."""

from __future__ import annotations

import os
import sys
import time
from typing import TextIO

CODES = {"good": "32", "warn": "33", "bad": "31", "faint": "2", "strong": "1"}
BAR_CELLS = 30
REDRAW_S = 0.1


def has_colour(stream: TextIO) -> bool:
    """NO_COLOR (no-color.org), a dumb terminal or a file mean plain text."""
    return stream.isatty() and not os.environ.get("NO_COLOR") and os.environ.get("TERM") != "dumb"


def painted(text: str, kind: str, *, colour: bool) -> str:
    return f"\x1b[{CODES[kind]}m{text}\x1b[0m" if colour else text


def printable(text: str) -> str:
    """Text from elsewhere without control characters, which could rewrite the terminal."""
    return "".join(letter if letter.isprintable() else "?" for letter in text)


class Progress:
    """One line on stderr that fills up; silent when stderr is no terminal."""

    def __init__(self, label: str, *, shown: bool = True, stream: TextIO | None = None) -> None:
        self._label = label
        self._stream = stream or sys.stderr
        self._shown = shown and self._stream.isatty()
        self._started_s = self._drawn_s = time.monotonic()

    def at(self, fraction: float, note: str = "") -> None:
        now = time.monotonic()
        if not self._shown or now - self._drawn_s < REDRAW_S:
            return
        self._drawn_s = now
        fraction = min(max(fraction, 0.0), 1.0)
        filled = round(fraction * BAR_CELLS)
        left = (now - self._started_s) * (1 - fraction) / fraction if fraction > 0.01 else 0.0
        bar = "#" * filled + "." * (BAR_CELLS - filled)
        self._stream.write(f"\r\x1b[2K{self._label} [{bar}] {fraction:4.0%} {left:.0f} s left  {note}")
        self._stream.flush()

    def done(self) -> None:
        if self._shown:
            self._stream.write("\r\x1b[2K")
            self._stream.flush()
