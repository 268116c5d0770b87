"""How the C library keeps memory: a robot's computer is small, and there may be twenty robots on one.

glibc gives every thread a heap of its own and keeps what was freed; both are told otherwise here.  Another C library has other
habits, and is left alone.
"""

from __future__ import annotations

import contextlib
import ctypes

M_MMAP_THRESHOLD, M_ARENA_MAX = -3, -8  # of glibc's mallopt


def keep_memory_small() -> None:
    """One heap for all threads, and large arrays given back at once.

    Two heaps and arrays of 1 MB saved 24 MB of 146; these and three snapshots (`MergeWorker`) 7 MB of a peak of 123, for no CPU.
    """
    with contextlib.suppress(OSError, AttributeError):
        libc = ctypes.CDLL(None)
        libc.mallopt(M_ARENA_MAX, 1)
        libc.mallopt(M_MMAP_THRESHOLD, 1 << 18)


def give_back_memory() -> None:
    """Pages that are free between others that are not, in less than 2 ms."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
