"""Translations by correlation: for one rotation, every shift of their map over ours is judged at once by a Fourier transform."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from agent.features.wall_points import WallPoints
from agent.features.working import WorkingGrid
from agent.merging.transforms import Poses, no_poses

CELL_M = 0.4  # coarse on purpose: refinement starts from 0.8 m away
#                        loose attached short long
KIND_WEIGHTS = np.array([0.2, 0.7, 1.0, 1.0], np.float32)
MAX_SIDE = 1536  # cells of a transform; larger pairs get larger cells


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """Where a map's walls and free space lie, as points worth about a coarse cell each."""

    walls_m: NDArray[np.float32]  # (N, 2) grid frame
    weights: NDArray[np.float32]  # (N,) how much a wall point counts
    free_m: NDArray[np.float32]  # (M, 2) centres of coarse free cells
    size_m: tuple[float, float]

    @staticmethod
    def of(grid: WorkingGrid, walls: WallPoints, kinds: NDArray[np.uint8]) -> Places:
        k = max(1, round(CELL_M / grid.resolution_m))
        h, w = grid.free.shape
        small = cv2.resize(grid.free.astype(np.float32), (max(1, w // k), max(1, h // k)), interpolation=cv2.INTER_AREA)
        rows, cols = np.nonzero(small > 0.5)
        cell_m = k * grid.resolution_m
        free = (np.stack([cols, rows], axis=1) + 0.5) * cell_m
        return Places(
            walls.positions_m, KIND_WEIGHTS[kinds], free.astype(np.float32), (w * grid.resolution_m, h * grid.resolution_m)
        )


def correlation_candidates(ours: Places, theirs: Places, rotations: NDArray[np.float64], peaks: int) -> Poses:
    """The best `peaks` shifts for every rotation."""
    if not len(ours.walls_m) or not len(theirs.walls_m):
        return no_poses()
    diagonal = math.hypot(*theirs.size_m)
    cell = max(CELL_M, (max(ours.size_m) + diagonal) / MAX_SIDE)
    side = math.ceil(diagonal / cell) + 2
    width = cv2.getOptimalDFTSize(math.ceil(ours.size_m[0] / cell) + side)
    height = cv2.getOptimalDFTSize(math.ceil(ours.size_m[1] / cell) + side)
    walls, free = _images(ours.walls_m, ours.weights, ours.free_m, cell, (height, width))
    near = cv2.GaussianBlur(walls, (5, 5), 0.7)
    near *= 1.0 / max(1e-6, float(near.max()))
    for_walls, for_free = cv2.dft(near - 0.5 * free), cv2.dft(near)
    middle = np.array(theirs.size_m) / 2
    poses = []
    for theta in rotations:
        turn = np.array([[math.cos(theta), math.sin(theta)], [-math.sin(theta), math.cos(theta)]], np.float32)
        shift = np.array([side, side]) * cell / 2 - middle @ turn
        their_walls, their_free = _images(
            theirs.walls_m @ turn + shift, theirs.weights, theirs.free_m @ turn + shift, cell, (height, width)
        )
        product = cv2.mulSpectrums(for_walls, cv2.dft(their_walls, nonzeroRows=side), 0, conjB=True)
        product -= 0.5 * cv2.mulSpectrums(for_free, cv2.dft(their_free, nonzeroRows=side), 0, conjB=True)
        surface = cv2.idft(product, flags=cv2.DFT_SCALE | cv2.DFT_REAL_OUTPUT)
        rows, cols = _peaks(surface, peaks)
        dx = np.where(cols > width - side, cols - width, cols) * cell + shift[0]
        dy = np.where(rows > height - side, rows - height, rows) * cell + shift[1]
        poses.append(np.stack([dx, dy, np.full(len(dx), theta)], axis=1))
    return np.concatenate(poses)


def _images(
    walls_m: NDArray[np.floating],
    weights: NDArray[np.float32],
    free_m: NDArray[np.floating],
    cell: float,
    shape: tuple[int, int],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Walls (their weight) and free space (1) as images; a cell with a wall is not free."""
    walls, free = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    order = np.argsort(weights, kind="stable")  # the weightiest point of a cell is written last
    walls[_cells(walls_m[order], cell, shape)] = weights[order]
    free[_cells(free_m, cell, shape)] = 1.0
    free[walls > 0] = 0.0
    return walls, free


def _cells(points_m: NDArray[np.floating], cell: float, shape: tuple[int, int]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    at = np.floor(points_m / cell).astype(np.int64)
    return np.clip(at[:, 1], 0, shape[0] - 1), np.clip(at[:, 0], 0, shape[1] - 1)


def _peaks(surface: NDArray[np.float32], count: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The highest local maxima."""
    highest = surface >= cv2.dilate(surface, np.ones((5, 5), np.uint8))
    found = np.flatnonzero(highest)
    values = surface.ravel()[found]
    if len(found) > count:
        found = found[np.argpartition(-values, count)[:count]]
    rows, cols = np.unravel_index(found, surface.shape)
    return rows, cols
