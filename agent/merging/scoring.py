"""How well wall points of one map sit on another, for thousands of transforms at once.

One gather and one look-up a point: the field's byte and the point's own direction bin index a table of what that
combination is worth, in metres of wall.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from agent.features.field import DIRECTION_BINS, FIRST_EDGE_BYTE, FREE_BYTE, UNKNOWN_BYTE, MatchField
from agent.features.structure import LOOSE
from agent.features.wall_points import SPACING_M, WallPoints, direction_bins
from agent.merging.transforms import Poses

AGREE_BINS = 9  # normals within 51 degrees agree: corners and clutter turn normals, walls of a corridor differ by 180
OPPOSITE_BINS = 23  # beyond 129 degrees: perhaps the far side of a thin wall
AGREEMENT_AT_TRUTH, CONFLICT_AT_TRUTH = 0.8, 0.15  # shares of wall that tell anything, true transforms
ALIGNED_BY_ACCIDENT, CROSSING_BY_ACCIDENT = 0.3, 0.4  # of wall that lies on walls: 102 of 360 degrees agree
USUAL_RATIO = 0.85  # of the two log likelihood ratios in offices, where walls are 45 % of what tells anything
Pixel = TypeVar("Pixel", np.uint8, np.float32)
_BLOCK = 400_000  # points at a time, so that temporaries stay in cache


@dataclass(frozen=True, slots=True, eq=False)
class Probe:
    """Points of a map made ready for scoring, grid frame."""

    xy1: NDArray[np.float32]  # (3, P) x, y, 1
    bins: NDArray[np.uint8]  # (P,) direction of the normals
    kinds: NDArray[np.uint16]  # (P,) what they are part of, shifted to the top two bits
    wall_m: float  # wall that one point stands for

    @staticmethod
    def of(walls: WallPoints, kinds: NDArray[np.uint8], wall_m: float = SPACING_M) -> Probe:
        xy1 = np.ones((3, len(walls)), np.float32)
        xy1[:2] = walls.positions_m.T
        return Probe(
            xy1, direction_bins(walls.angles_rad, DIRECTION_BINS), np.left_shift(kinds.astype(np.uint16), np.uint16(14)), wall_m
        )

    @staticmethod
    def sample(walls: WallPoints, kinds: NDArray[np.uint8], count: int) -> Probe:
        """About `count` points spread over the map's walls; loose things only where there is little else."""
        firm = np.flatnonzero(kinds != LOOSE)
        rows = firm if len(firm) >= count else np.arange(len(walls))
        wall_m = SPACING_M * max(1.0, len(rows) / count)
        if len(rows) > count:
            rows = rows[np.linspace(0, len(rows) - 1, count).astype(np.int64)]
        return Probe.of(walls.subset(rows), kinds[rows], wall_m)


NOTHING, AGREES, CONFLICTS, CROSSES, OPPOSITE = range(5)  # what a field says to a wall point


def outcome_table() -> NDArray[np.uint8]:
    """(256, 64) what field byte and direction bin say together."""
    byte, own = np.arange(256)[:, None], np.arange(DIRECTION_BINS)[None, :]
    apart = np.abs((byte - own + DIRECTION_BINS // 2) % DIRECTION_BINS - DIRECTION_BINS // 2)
    wall = np.where(apart <= AGREE_BINS, AGREES, np.where(apart < OPPOSITE_BINS, CROSSES, OPPOSITE))
    edge = np.where(apart <= AGREE_BINS, NOTHING, CONFLICTS)
    free = np.where(byte == FREE_BYTE, CONFLICTS, NOTHING)
    outcome = np.where(byte < FIRST_EDGE_BYTE, wall, np.where(byte < FIRST_EDGE_BYTE + DIRECTION_BINS, edge, free))
    return outcome.astype(np.uint8)


Worths = tuple[tuple[float, float, float, float], ...]  # for every kind: of agreeing, conflicting, crossing and opposite


def worth_table(by_kind: Worths, field: MatchField) -> NDArray[np.float32]:
    """(4 * 256 * 64,) worth of a point by kind, field byte and direction bin, on this field."""
    factors = np.array([0.0, 1.0] + [weight_against(field.wall_share)] * 3, np.float32)
    worths = [np.array([0.0, *worth], np.float32) * factors for worth in by_kind]
    outcome = outcome_table()
    return np.concatenate([worth[outcome].ravel() for worth in worths])


def weight_against(wall_share: float) -> float:
    """What conflicts weigh beside agreement in a map with this share of walls, 1 in a building of rooms.

    Both are log likelihood ratios of the true transform to an accidental one.  Where walls are few and space is wide, an
    accident hits a wall seldom and free space nearly always: agreement tells more there, and conflict less.
    """
    share = min(max(wall_share, 0.02), 0.9)
    by_accident = ALIGNED_BY_ACCIDENT * share, 1.0 - (1.0 - CROSSING_BY_ACCIDENT) * share
    ratio = math.log(by_accident[1] / CONFLICT_AT_TRUTH) / math.log(AGREEMENT_AT_TRUTH / by_accident[0])
    return min(1.0, ratio / USUAL_RATIO)


# Rounded from likelihood ratios at true and wrong transforms of the recordings, where the optimum is flat.  Agreement along a
# long wall says little (a corridor agrees with any corridor), its absence much; the absence of loose things says nothing.
SEARCH_WORTH: Worths = (
    (0.6, -0.1, 0.0, 0.0),  # loose
    (1.0, -0.8, -0.3, -0.2),  # attached
    (1.0, -1.2, -0.4, -0.2),  # short
    (0.8, -1.6, -0.6, -0.2),  # long
)


def readings(field: NDArray[np.uint8], resolution_m: float, probe: Probe, poses: Poses) -> NDArray[np.uint16]:
    """(C, P) kind, field byte and direction bin of every point under every transform, as one table index."""
    x, y = placed(probe.xy1, poses, resolution_m)
    seen = looked_up(field, x, y, outside=UNKNOWN_BYTE)
    turn = np.rint(poses[:, 2] * (DIRECTION_BINS / math.tau)).astype(np.int64).astype(np.uint8)
    index: NDArray[np.uint16] = seen.astype(np.uint16)
    index <<= 6
    index |= (probe.bins[None, :] + turn[:, None]) & 63
    index |= probe.kinds[None, :]
    return index


def looked_up(image: NDArray[Pixel], columns: NDArray[np.float32], rows: NDArray[np.float32], outside: float) -> NDArray[Pixel]:
    """The image at many places at once, nearest pixel; none asked, none told (cv2 refuses to be asked nothing)."""
    if not columns.size:
        return np.zeros(columns.shape, image.dtype)
    found: NDArray[Pixel] = cv2.remap(
        image, columns, rows, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=outside
    )
    return found


def placed(xy1: NDArray[np.float32], poses: Poses, resolution_m: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(C, P) columns and rows, in cv2's pixel coordinates, of the points under every transform."""
    c, s = np.cos(poses[:, 2]) / resolution_m, np.sin(poses[:, 2]) / resolution_m
    x0, y0 = poses[:, 0] / resolution_m - 0.5, poses[:, 1] / resolution_m - 0.5
    columns = np.stack([c, -s, x0], axis=1).astype(np.float32) @ xy1
    rows = np.stack([s, c, y0], axis=1).astype(np.float32) @ xy1
    return columns, rows


def scores(
    field: NDArray[np.uint8], resolution_m: float, probe: Probe, poses: Poses, worth: NDArray[np.float32]
) -> NDArray[np.float32]:
    """(C,) metres of wall for, less metres against, of every transform."""
    points = probe.xy1.shape[1]
    if not points or not len(poses):
        return np.zeros(len(poses), np.float32)
    step = max(1, min(32_000, _BLOCK // points))
    blocks = [poses[i : i + step] for i in range(0, len(poses), step)]
    sums = [worth.take(readings(field, resolution_m, probe, block)).sum(axis=1) for block in blocks]
    return np.concatenate(sums) * np.float32(probe.wall_m)
