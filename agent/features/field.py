"""What a map says at a place, made to be asked millions of times: one byte a cell, and the index of the nearest wall point.

byte  0..63   within tolerance of a wall, whose signed normal points this way (64 bins over the full turn)
      64..127 free, where free space ends at the unknown: the way back into it.  A wall seen only along itself ends so: beams
              passed in front of it and none hit, so a wall of the other map that faces this way is no contradiction
      254     free, and farther than the tolerance from any wall
      255     no evidence: unknown, or outside
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from agent.features.wall_points import WallPoints, direction_bins
from agent.features.working import WorkingGrid

DIRECTION_BINS = 64
FIRST_EDGE_BYTE = DIRECTION_BINS
FREE_BYTE = 254
UNKNOWN_BYTE = 255
FINE_TOLERANCE_M = 0.25  # a wall this near is the same wall; also what a judge calls agreement
COARSE_TOLERANCE_M = 0.35  # for candidates that are not refined yet
EDGE_M = 0.45  # free space this near to the unknown may end at a wall that was not hit
REACH_M = 0.80  # refinement pulls walls together from here
SEEN_M = 1.5  # distances end here: nothing asks for more, and what is told of a place depends on what is near it only


@dataclass(frozen=True, slots=True, eq=False)
class MatchField:
    """Images over the working grid."""

    fine: NDArray[np.uint8]  # (H, W) bytes as above, tolerance FINE_TOLERANCE_M
    coarse: NDArray[np.uint8]  # (H, W) the same, tolerance COARSE_TOLERANCE_M
    nearest: NDArray[
        np.float32
    ]  # (H, W) index of the nearest wall point, -1 out of reach; float because cv2.remap takes no int32
    distance_m: NDArray[np.float32]  # (H, W) to the nearest wall, at most `seen_m`
    wall_share: float  # of the cells that tell anything
    resolution_m: float

    @staticmethod
    def of(grid: WorkingGrid, walls: WallPoints) -> MatchField:
        distance_m, nearest = _nearest_wall(grid, walls)
        bins = direction_bins(walls.angles_rad, DIRECTION_BINS)
        fine = _away_from_walls(grid)
        coarse = fine.copy()
        for image, tolerance_m in (
            (fine, max(FINE_TOLERANCE_M, 1.25 * grid.resolution_m)),
            (coarse, max(COARSE_TOLERANCE_M, 1.5 * grid.resolution_m)),
        ):
            near = np.flatnonzero(distance_m <= tolerance_m)
            image.ravel()[near] = bins[nearest.ravel()[near].astype(np.int64)]
        seen = np.float32(seen_m(grid.resolution_m))
        return MatchField.made_of(fine, coarse, nearest, np.minimum(distance_m, seen), grid.resolution_m)

    @staticmethod
    def made_of(
        fine: NDArray[np.uint8],
        coarse: NDArray[np.uint8],
        nearest: NDArray[np.float32],
        distance_m: NDArray[np.float32],
        resolution_m: float,
    ) -> MatchField:
        told = int(np.count_nonzero(fine != UNKNOWN_BYTE))
        return MatchField(
            fine, coarse, nearest, distance_m, int(np.count_nonzero(fine < DIRECTION_BINS)) / max(1, told), resolution_m
        )


def seen_m(resolution_m: float) -> float:
    """How far what a field tells of a place depends on what is around it."""
    return max(SEEN_M, 2.0 * resolution_m)


def _away_from_walls(grid: WorkingGrid) -> NDArray[np.uint8]:
    """(H, W) what cells say that have no wall within tolerance."""
    free = grid.free.view(np.bool_)
    unknown = cv2.morphologyEx(1 - (grid.free | grid.occupied), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    side = 2 * max(1, round(EDGE_M / grid.resolution_m)) + 1
    near = cv2.dilate(unknown, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))).view(np.bool_)
    soft = cv2.blur(unknown.astype(np.float32), (side + 2, side + 2))
    rows, cols = np.nonzero(near & free)
    into_free = np.arctan2(-cv2.Sobel(soft, cv2.CV_32F, 0, 1)[rows, cols], -cv2.Sobel(soft, cv2.CV_32F, 1, 0)[rows, cols])
    said = np.where(free, np.uint8(FREE_BYTE), np.uint8(UNKNOWN_BYTE))
    said[rows, cols] = FIRST_EDGE_BYTE + direction_bins(into_free, DIRECTION_BINS)
    return said


def _nearest_wall(grid: WorkingGrid, walls: WallPoints) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(H, W) distance to the nearest surface cell, metres, and its row in `walls`, -1 out of reach."""
    nearest = np.full(grid.free.shape, -1, np.float32)
    if not len(walls):
        return np.full(grid.free.shape, np.inf, np.float32), nearest
    apart = np.ones(grid.free.shape, np.uint8)
    rows, cols = walls.cells_rc.T
    apart[rows, cols] = 0
    distance, labels = cv2.distanceTransformWithLabels(apart, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    index_of = np.zeros(len(walls) + 1, np.float32)
    index_of[labels[rows, cols]] = np.arange(len(walls))
    distance_m = distance * np.float32(grid.resolution_m)
    near = np.flatnonzero(distance_m <= max(REACH_M, 1.5 * grid.resolution_m))
    nearest.ravel()[near] = index_of[labels.ravel()[near]]
    return distance_m, nearest
