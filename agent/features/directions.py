"""In which directions a map's walls face, as a fine circular histogram: correlating two gives the rotations between the maps.

Every line is a Gaussian as wide as it is uncertain.  Normals carry the free side's sign, so the histogram spans the full turn.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from agent.features.lines import WallLines

BINS = 1440  # a quarter of a degree
MAX_WEIGHT_M = 15.0  # one long corridor must not drown a whole office
MAX_SIGMA_DEG = 2.0
BLUR_DEG = 0.7  # lines of one building are parallel to about this


def direction_spectrum(lines: WallLines) -> NDArray[np.complex128]:
    """(BINS // 2 + 1,) Fourier transform of the histogram."""
    sigma_deg = np.hypot(np.minimum(np.degrees(lines.sigma_theta_rad), MAX_SIGMA_DEG), BLUR_DEG)
    weight = np.minimum(lines.lengths_m, MAX_WEIGHT_M)
    k = np.arange(BINS // 2 + 1)
    group = np.digitize(sigma_deg, SIGMA_STEPS_DEG)
    spectrum = np.zeros(len(k), np.complex128)
    for i, step_deg in enumerate(SIGMA_CENTRES_DEG):
        mine = group == i
        if mine.any():
            position = np.rint(lines.angles_rad[mine] * (BINS / math.tau)).astype(np.int64) % BINS
            histogram = np.bincount(position, weight[mine], minlength=BINS)
            spectrum += np.fft.rfft(histogram) * np.exp(-0.5 * (k * math.radians(step_deg)) ** 2)
    return spectrum


SIGMA_STEPS_DEG = np.array([0.8, 1.05, 1.4, 1.8])
SIGMA_CENTRES_DEG = (0.73, 0.9, 1.2, 1.6, 2.1)
