"""How a command ends in order: signals unwind it, and what it said is written before it is called done."""

from __future__ import annotations

import contextlib
import io
import os
import signal
import sys
import threading
from collections.abc import Iterator
from typing import NoReturn


class Ended(BaseException):
    """A signal asked for the end: what is open is closed on the way out, a LIDAR's motor stopped, a recording finished."""

    def __init__(self, number: int) -> None:
        self.number = number


@contextlib.contextmanager
def ending_in_order() -> Iterator[None]:
    """SIGTERM, and SIGHUP of a terminal that went away, unwind the command as Ctrl-C does; commands may have their own way."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    caught = [number for number in (signal.SIGTERM, signal.SIGHUP) if signal.getsignal(number) is signal.SIG_DFL]
    for number in caught:
        signal.signal(number, _end)
    try:
        yield
    finally:
        for number in caught:
            if signal.getsignal(number) is _end:
                signal.signal(number, signal.SIG_DFL)


def _end(number: int, _: object) -> NoReturn:
    raise Ended(number)


@contextlib.contextmanager
def seen_off() -> Iterator[None]:
    """What a pipe or a disk does not take is noticed inside, not while Python ends; letters a terminal lacks come as escapes."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        yield
    except SystemExit:  # --help, --version
        _flush()
        raise
    _flush()


def _flush() -> None:
    if sys.stdout is not None:  # started with it closed
        sys.stdout.flush()


def close_stdout() -> None:
    """Nobody takes any more: what is still buffered goes nowhere."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
