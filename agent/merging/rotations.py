"""Which rotations bring the walls of two maps to face the same ways: peaks of the correlation of their direction histograms."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from agent.features.directions import BINS

MAX_ROTATIONS = 16
APART_DEG = 2.5


def rotation_candidates(ours: NDArray[np.complex128], theirs: NDArray[np.complex128], limit: int) -> NDArray[np.float64]:
    """(R,) rotations (radians) of their frame into ours, the most supported first."""
    correlation = np.fft.irfft(ours * theirs.conj(), BINS)
    before, after = np.roll(correlation, 1), np.roll(correlation, -1)
    peaks = np.flatnonzero((correlation >= before) & (correlation > after) & (correlation > 0))
    peaks = peaks[np.argsort(-correlation[peaks], kind="stable")]
    bend = before[peaks] - 2 * correlation[peaks] + after[peaks]
    offset = 0.5 * (before[peaks] - after[peaks]) / np.where(bend == 0, 1, bend)
    angles = (peaks + offset) * (math.tau / BINS)
    chosen: list[float] = []
    for angle in angles:
        if len(chosen) == min(limit, MAX_ROTATIONS):
            break
        if all(abs(math.remainder(angle - other, math.tau)) > math.radians(APART_DEG) for other in chosen):
            chosen.append(float(angle))
    return np.array(chosen)
