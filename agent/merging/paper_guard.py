"""The paper's candidates with four guards it does not have: `method = "paper-guarded"`.

1. a tenth of the smaller map must overlap, so that slivers drop out;
2. candidates are ranked by metres of wall that fall on wall, less twice those that fall on the other map's free space;
3. the best must beat every distinct alternative by metres of wall and by ratio: a corridor that fits in two places stays apart;
4. once refined below the bins of the vote, it must pass the judge of the hybrid method (`verify_match`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from agent.features.snapshot import MapSnapshot
from agent.merging.equations import BIN_COVARIANCE, Candidate, overlap_m2
from agent.merging.result import Alternative, MatchOptions, MatchStatus, MergeResult, Reason
from protocol.geometry import SE2, wrap_angle
from protocol.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

MIN_OVERLAP = 0.10  # of the smaller map's known area
HIT_TOLERANCE_M = 0.25  # half a bin of the translation vote and a degree of turn at 10 m
CONFLICT_COST = 2.0  # a metre of wall in their free space outweighs two that fit
MIN_HIT_SHARE = 0.55
MAX_RIVAL_SHARE = 0.6
DISTINCT_M, DISTINCT_RAD = 0.8, 0.105  # candidates nearer than this (6 degrees) are the same hypothesis
_MAX_POINTS = 2000  # a map: enough to weigh 100 m of wall to 5 %


def choose_guarded(ours: MapSnapshot, theirs: MapSnapshot, candidates: list[Candidate], options: MatchOptions) -> MergeResult:
    """The verdict on the paper's candidates; NO and AMBIGUOUS carry the best hypothesis and the numbers."""
    smaller_m2 = min(ours.grid.known_area_m2(), theirs.grid.known_area_m2())
    wide = [c for c in candidates if overlap_m2(c.factor, ours.grid) >= MIN_OVERLAP * smaller_m2]
    if not wide:
        return MergeResult.none(Reason.NO_CANDIDATES)
    scale = WallScale.of(ours.grid, theirs.grid)
    weighed = sorted(((scale.weigh(c.T_ours_theirs), c) for c in wide), key=lambda pair: -pair[0].score_m)
    weight, best = weighed[0]
    centre = theirs.grid.points_of(np.argwhere(theirs.grid.known()).mean(axis=0, keepdims=True))
    rivals = [(w, c) for w, c in weighed[1:] if _is_distinct(best.T_ours_theirs, c.T_ours_theirs, centre)][:5]
    rival_m = max(0.0, rivals[0][0].score_m) if rivals else 0.0
    status, reason = _verdict(best, weight, rival_m, options)
    result = MergeResult(
        status,
        best.T_ours_theirs,
        BIN_COVARIANCE,
        factor=best.factor,
        overlap_m2=overlap_m2(best.factor, ours.grid),
        score=weight.score_m,
        runner_up_score=rival_m,
        candidates_tried=len(candidates),
        reason=reason,
        alternatives=tuple(Alternative(c.T_ours_theirs, w.score_m) for w, c in rivals),
        evidence={"agreeing_wall_m": weight.agreeing_m, "conflicting_wall_m": weight.conflicting_m},
    )
    return _verified(ours, theirs, result, options) if result.accepted else result


def _verified(ours: MapSnapshot, theirs: MapSnapshot, result: MergeResult, options: MatchOptions) -> MergeResult:
    """The result refined, if the hybrid's judge agrees; else a NO with that judge's reason."""
    from agent.merging.matching import verify_match  # noqa: PLC0415  (matching dispatches to this module)

    assert result.T_ours_theirs is not None
    judged = verify_match(ours, theirs, result.T_ours_theirs, options)
    if not judged.accepted:
        return replace(result, status=MatchStatus.NO, reason=judged.reason)
    return replace(result, T_ours_theirs=judged.T_ours_theirs, covariance=judged.covariance)


def _verdict(best: Candidate, weight: Weight, rival_m: float, options: MatchOptions) -> tuple[MatchStatus, str]:
    if best.factor.value <= options.min_match_factor:
        return MatchStatus.NO, Reason.LOW_MATCH_FACTOR
    if weight.score_m < options.min_margin_m:
        return MatchStatus.NO, Reason.LITTLE_WALL
    if weight.agreeing_m < MIN_HIT_SHARE * (weight.agreeing_m + weight.conflicting_m):
        return MatchStatus.NO, Reason.CONFLICTS
    if weight.score_m - rival_m < options.min_margin_m or rival_m > MAX_RIVAL_SHARE * weight.score_m:
        return MatchStatus.AMBIGUOUS, Reason.RIVAL
    return MatchStatus.MERGED, Reason.MATCHED


def _is_distinct(T_a: SE2, T_b: SE2, centre_m: NDArray[np.float64]) -> bool:
    """Whether the two transforms take the middle of their map to places, or headings, that nobody would confuse."""
    moved_m = float(np.hypot(*(T_a.apply(centre_m) - T_b.apply(centre_m))[0]))
    return moved_m > DISTINCT_M or abs(wrap_angle(T_a.theta_rad - T_b.theta_rad)) > DISTINCT_RAD


@dataclass(frozen=True, slots=True)
class Weight:
    """Metres of wall for and against a transform, both directions averaged."""

    agreeing_m: float
    conflicting_m: float

    @property
    def score_m(self) -> float:
        return self.agreeing_m - CONFLICT_COST * self.conflicting_m


@dataclass(frozen=True, slots=True, eq=False)
class WallScale:
    """Weighs transforms of one pair of maps by where the walls of each fall in the other."""

    ours: _Walls
    theirs: _Walls

    @staticmethod
    def of(ours: OccupancyGrid, theirs: OccupancyGrid) -> WallScale:
        return WallScale(_Walls.of(ours), _Walls.of(theirs))

    def weigh(self, T_ours_theirs: SE2) -> Weight:
        there = self.ours.meets(T_ours_theirs.apply(self.theirs.points_m), self.theirs.metres_each)
        back = self.theirs.meets(T_ours_theirs.inverse().apply(self.ours.points_m), self.ours.metres_each)
        return Weight((there[0] + back[0]) / 2, (there[1] + back[1]) / 2)


@dataclass(frozen=True, slots=True, eq=False)
class _Walls:
    """Wall points of a map, and the map with its walls widened by the tolerance."""

    widened: OccupancyGrid
    points_m: NDArray[np.float64]  # (N, 2) map frame
    metres_each: float  # of wall for which one point stands

    @staticmethod
    def of(grid: OccupancyGrid) -> _Walls:
        cells = np.argwhere(grid.cells == OCCUPIED)
        step = max(1, -(-len(cells) // _MAX_POINTS))
        return _Walls(_widened(grid), grid.points_of(cells[::step]), grid.resolution_m * step)

    def meets(self, points_m: NDArray[np.float64], metres_each: float) -> tuple[float, float]:
        """Metres of the other map's wall that fall on this map's walls, and on its free space."""
        values = self.widened.values_at(points_m)
        on_wall, on_free = np.count_nonzero(values == OCCUPIED), np.count_nonzero(values == FREE)
        return on_wall * metres_each, on_free * metres_each


def _widened(grid: OccupancyGrid) -> OccupancyGrid:
    side = 2 * round(HIT_TOLERANCE_M / grid.resolution_m) + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    margin = side // 2
    cells = np.pad(grid.cells, margin, constant_values=UNKNOWN)
    walls = cv2.dilate((cells == OCCUPIED).astype(np.uint8), kernel)
    cells[walls > 0] = OCCUPIED
    corner = SE2(-margin * grid.resolution_m, -margin * grid.resolution_m, 0.0)
    return OccupancyGrid(cells, grid.resolution_m, grid.origin @ corner)
