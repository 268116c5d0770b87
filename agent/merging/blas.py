"""Small matrix products stay on the thread that asks for them.

A program that loads NumPy without OPENBLAS_NUM_THREADS=1 has products of a few hundred rows done by all cores; on a busy machine
these wait for one another, spinning, and a match takes three times its CPU.  Our own commands set the variable; others may not.
"""

from __future__ import annotations

import contextlib
import ctypes
from collections.abc import Iterator

import numpy as np

NAMES = ("scipy_openblas_{}_num_threads64_", "openblas_{}_num_threads64_", "openblas_{}_num_threads")


def _threads() -> tuple[ctypes._NamedFuncPointer, ctypes._NamedFuncPointer] | None:
    """OpenBLAS's own functions to read and to set how many; None where NumPy was built with another library."""
    with contextlib.suppress(OSError, AttributeError):
        library = ctypes.CDLL(np._core._multiarray_umath.__file__)  # type: ignore[attr-defined]
        for name in NAMES:
            if hasattr(library, name.format("get")):
                return library[name.format("get")], library[name.format("set")]
    return None


_THREADS = _threads()


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """As many threads as before at the end."""
    before = _THREADS[0]() if _THREADS else 1
    if before == 1:
        yield
        return
    assert _THREADS is not None
    _THREADS[1](1)
    try:
        yield
    finally:
        _THREADS[1](before)
