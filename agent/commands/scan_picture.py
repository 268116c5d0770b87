"""One scan as a picture: the sensor in the middle, x up, y to the left, rings every metre (or two, or five)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from hw.readings import LaserScan

Image = NDArray[np.uint8]
BACKGROUND_BGR, RING_BGR, BEAM_BGR, POINT_BGR, SENSOR_BGR = (
    (252, 252, 252),
    (225, 225, 225),
    (244, 236, 222),
    (150, 60, 20),
    (40, 40, 200),
)


def scan_picture(scan: LaserScan, size_px: int = 800) -> Image:
    """(size, size, 3) BGR."""
    image: Image = np.full((size_px, size_px, 3), BACKGROUND_BGR, np.uint8)
    is_seen = np.isfinite(scan.ranges_m)
    ranges_m, angles = scan.ranges_m[is_seen].astype(np.float64), scan.angles_rad[is_seen].astype(np.float64)
    reach_m = float(np.percentile(ranges_m, 98)) * 1.1 if len(ranges_m) else scan.range_max_m
    centre, px_per_m = size_px / 2, size_px / 2 / max(reach_m, 0.5)
    points = np.column_stack([centre - px_per_m * ranges_m * np.sin(angles), centre - px_per_m * ranges_m * np.cos(angles)])
    points_px = np.round(points).astype(np.int32)
    for point in points_px:
        cv2.line(image, (size_px // 2, size_px // 2), (int(point[0]), int(point[1])), BEAM_BGR, 1, cv2.LINE_AA)
    _rings(image, reach_m, px_per_m)
    for point in points_px:
        cv2.circle(image, (int(point[0]), int(point[1])), 2, POINT_BGR, -1, cv2.LINE_AA)
    middle = size_px // 2
    arrow = np.array([[middle, middle - 12], [middle - 7, middle + 8], [middle + 7, middle + 8]], np.int32)
    cv2.fillPoly(image, [arrow], SENSOR_BGR, cv2.LINE_AA)
    return image


def _rings(image: Image, reach_m: float, px_per_m: float) -> None:
    step_m = next(step for step in (0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0) if reach_m / step <= 6 or step == 50.0)
    middle = image.shape[0] // 2
    for k in range(1, int(reach_m / step_m) + 1):
        radius = round(k * step_m * px_per_m)
        cv2.circle(image, (middle, middle), radius, RING_BGR, 1, cv2.LINE_AA)
        cv2.putText(
            image, f"{k * step_m:g} m", (middle + 4, middle - radius - 3), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (150, 150, 150), 1
        )
