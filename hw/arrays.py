"""The arrays that decoders hand on to one another."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]
Ints = NDArray[np.int64]
Floats = NDArray[np.float64]


def median(values: NDArray[np.float64]) -> float:
    """The upper median, without the cost of `np.median`."""
    middle = len(values) // 2
    return float(np.partition(values, middle)[middle])
