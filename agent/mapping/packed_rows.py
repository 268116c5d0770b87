"""Short arrays of differing lengths, end to end in one: the head of a small array is larger than what it holds."""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

GROW = 1.25  # times as many rows when there is no room left


class PackedRows:
    """Like a list of arrays (N, ...) that are only ever added at the end and let go at the beginning."""

    def __init__(self, empty: NDArray[Any], parts: Iterable[NDArray[Any]] = ()) -> None:
        self._rows = empty  # (capacity, ...)
        self._ends = array("q", [0])  # of each part, behind the beginning of the first
        for part in parts:
            self.append(part)

    def __len__(self) -> int:
        return len(self._ends) - 1

    def __getitem__(self, k: int) -> NDArray[Any]:
        if not -len(self) <= k < len(self):
            raise IndexError(k)
        k %= len(self)
        return self._rows[self._ends[k] : self._ends[k + 1]]

    def __iter__(self) -> Iterator[NDArray[Any]]:
        return (self[k] for k in range(len(self)))

    def append(self, rows: NDArray[Any]) -> None:
        first, end = self._ends[-1], self._ends[-1] + len(rows)
        if end > len(self._rows):
            grown = np.empty((max(end, int(GROW * len(self._rows))), *self._rows.shape[1:]), self._rows.dtype)
            grown[:first] = self._rows[:first]
            self._rows = grown
        self._rows[first:end] = rows
        self._ends.append(end)

    def drop(self, n: int) -> None:
        """Let the first n go."""
        first, end = self._ends[n], self._ends[-1]
        self._rows = self._rows[first:end].copy()
        self._ends = array("q", [e - first for e in self._ends[n:]])
