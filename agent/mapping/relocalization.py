"""Where on the whole map is the robot, when it may have been carried anywhere?

One scan is correlated with the coarse field at every place and heading, a few headings per call so that no scan waits.
The few best places are refined on the fine field; only one that fits well, and clearly better than any place elsewhere,
is an answer.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from agent.mapping.correlation import COARSE_M, CoarseField, coarse_points
from agent.mapping.likelihood import TiledFields
from agent.mapping.scan_matching import Poses, information, refine

HEADINGS = 90  # 4 degrees apart: at 8 m the field's kernel still covers half of that
HEADINGS_A_CALL = 6  # about 20 ms on a map of 60 x 60 m
CELL_M = 2 * COARSE_M
PEAKS_A_HEADING = 3
CANDIDATES = 24
APART_M = 1.0  # answers nearer than this are the same place ...
APART_RAD = 0.35  # ... when they look the same way too
FITS = 0.6  # mean field value of a believed answer
CLEARLY_BETTER = 0.12  # than the best other place: two equal rooms give no answer


class Relocalization:
    """The search for one scan's place; `step` until `is_done`."""

    def __init__(self, coarse: CoarseField, surfels: NDArray[np.float32], stamp_s: float) -> None:
        self.surfels = surfels
        self.stamp_s = stamp_s
        self.field = halved(coarse.blurred(coarse.first, coarse.first + coarse.empty.shape))
        self.first_m = coarse.first[::-1] * COARSE_M  # (x, y) of the field's corner
        self.next_heading = 0
        self.peaks: list[tuple[float, float, float, float]] = []  # score, x, y, theta

    @property
    def is_done(self) -> bool:
        return self.next_heading == HEADINGS

    def step(self) -> None:
        """Score a few more headings everywhere."""
        points = coarse_points(self.surfels[:, :2], CELL_M)
        for heading in range(self.next_heading, min(self.next_heading + HEADINGS_A_CALL, HEADINGS)):
            theta = heading * math.tau / HEADINGS - math.pi
            self.peaks += self._peaks(points, theta)
        self.next_heading = min(self.next_heading + HEADINGS_A_CALL, HEADINGS)

    def _peaks(self, points_m: NDArray[np.float32], theta: float) -> list[tuple[float, float, float, float]]:
        """The best places for one heading: the field, correlated with the turned scan as a kernel around the robot."""
        cos, sin = math.cos(theta), math.sin(theta)
        turned = points_m @ np.array([[cos, sin], [-sin, cos]], np.float32)
        cells = np.floor(turned / CELL_M + 0.5).astype(np.int64)
        half = int(np.abs(cells).max())
        kernel = np.zeros((2 * half + 1, 2 * half + 1), np.float32)
        np.add.at(kernel, (cells[:, 1] + half, cells[:, 0] + half), np.float32(1.0 / len(cells)))
        scores = cv2.filter2D(self.field, cv2.CV_32F, kernel, borderType=cv2.BORDER_CONSTANT)
        found = []
        for _ in range(PEAKS_A_HEADING):
            _, score, _, (col, row) = cv2.minMaxLoc(scores)
            x, y = self.first_m + (np.array([col, row]) + 0.5) * CELL_M
            found.append((float(score), float(x), float(y), theta))
            scores[max(row - 2, 0) : row + 3, max(col - 2, 0) : col + 3] = 0.0
        return found

    def answer(self, fields: TiledFields, particle: int) -> NDArray[np.float64] | None:
        """(3,) the robot's pose when the scan was made; None when nothing fits, or several places do."""
        self.peaks.sort(key=lambda peak: -peak[0])
        starts = np.array([peak[1:] for peak in self.peaks[:CANDIDATES]])
        reach_m = float(np.hypot(self.surfels[:, 0], self.surfels[:, 1]).max()) + 2.0
        fields.cover(starts[:, :2].min(axis=0) - reach_m, starts[:, :2].max(axis=0) + reach_m)
        n = len(starts)
        weak = np.broadcast_to(information(1.0, 0.5), (n, 3, 3))
        fit = refine(fields, np.full(n, particle), starts, starts, weak, self.surfels, iterations=10)
        fractions = fit.fractions()
        best = int(np.argmax(fractions))
        others = fractions[[is_elsewhere(fit.poses[best], pose) for pose in fit.poses]]
        is_clear = len(others) == 0 or others.max() < fractions[best] - CLEARLY_BETTER
        return fit.poses[best] if fractions[best] >= FITS and is_clear else None


def is_elsewhere(a: Poses, b: Poses) -> bool:
    turn = abs((a[2] - b[2] + math.pi) % math.tau - math.pi)
    return bool(math.hypot(*(a - b)[:2]) > APART_M or turn > APART_RAD)


def halved(cells: NDArray[np.float32]) -> NDArray[np.float32]:
    """Cells twice as large, each the largest of its four."""
    even = cells[: cells.shape[0] // 2 * 2, : cells.shape[1] // 2 * 2]
    return np.asarray(even.reshape(even.shape[0] // 2, 2, even.shape[1] // 2, 2).max(axis=(1, 3)))
