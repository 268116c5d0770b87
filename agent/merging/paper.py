"""Algorithm 1 of Alnounou et al., "Occupancy Grid Map Merging Using Feature Maps", to the letter: `method = "paper"`.

Features of one kind and alike in size vote for rotations, then for translations; every candidate is validated by counting
cells (equations 1 to 3), the highest match factor wins, and above 0.85 the maps merge.  Where the paper is silent this is
charitable: orientation differences keep their sign, lines have no direction so both theta and theta + 180 degrees are tried,
and the candidate lists end at a budget.

The factor is mostly free space, so it accepts nearly any pair of buildings, and a sliver of overlap scores 1.0.  That is why
this is a baseline and not what robots use.  `method = "paper-guarded"` keeps the paper's candidates and gate, and adds what
`paper_guard.py` says.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent.features.paper import FeatureRows, PaperFeatures, paper_features
from agent.features.snapshot import MapSnapshot
from agent.merging.equations import BIN_COVARIANCE, Candidate, FactorCounter, overlap_m2
from agent.merging.paper_guard import choose_guarded
from agent.merging.result import MatchOptions, MatchStatus, MergeResult, Reason
from protocol.geometry import SE2, wrap_angle
from protocol.grid import OccupancyGrid

TRANSLATION_BIN_M = 0.2  # the paper's cell
MAX_ROTATIONS = 30  # most frequent first; each is tried as theta and theta + 180 degrees
MAX_TRANSLATIONS = 40  # most frequent first, for each rotation
MIN_TRANSLATIONS = 3
MAX_CELLS_COUNTED = 4_000_000_000  # over all candidates: maps beyond 1.6 million cells get fewer, to end within seconds
_ROW = 1 << 32  # packs two bins into one integer, which sorts ten times faster than pairs


@dataclass(frozen=True, slots=True, eq=False)
class SimilarFeatures:
    """Pairs of one kind that are alike in size: row i of `ours` may be row i of `theirs`."""

    ours: FeatureRows  # (N, 4)
    theirs: FeatureRows  # (N, 4)
    directed: NDArray[np.bool_]  # (N,) whether the pair has orientations to compare: circles do not

    def __len__(self) -> int:
        return len(self.ours)


def match_maps_like_the_paper(ours: MapSnapshot, theirs: MapSnapshot, options: MatchOptions) -> MergeResult:
    """`method = "paper"`, and `"paper-guarded"`."""
    if options.method == "paper-guarded":
        return match_guarded(ours, theirs, options)
    return match_by_the_paper(ours.grid, theirs.grid, options)


def match_by_the_paper(ours: OccupancyGrid, theirs: OccupancyGrid, options: MatchOptions) -> MergeResult:
    """Algorithm 1: the candidate with the highest match factor, accepted above the gate."""
    candidates = paper_candidates(ours, theirs, options)
    if not candidates:
        return MergeResult.none(Reason.NO_CANDIDATES)
    best = max(candidates, key=lambda candidate: (candidate.factor.value, candidate.factor.agree))
    is_accepted = best.factor.value > options.min_match_factor
    return MergeResult(
        MatchStatus.MERGED if is_accepted else MatchStatus.NO,
        best.T_ours_theirs,
        BIN_COVARIANCE,
        factor=best.factor,
        overlap_m2=overlap_m2(best.factor, ours),
        score=best.factor.value,
        candidates_tried=len(candidates),
        reason=Reason.MATCHED if is_accepted else Reason.LOW_MATCH_FACTOR,
    )


def match_guarded(ours: MapSnapshot, theirs: MapSnapshot, options: MatchOptions) -> MergeResult:
    """Algorithm 1's candidates, chosen and judged with the guards of `paper_guard.py`."""
    return choose_guarded(ours, theirs, paper_candidates(ours.grid, theirs.grid, options), options)


def paper_candidates(ours: OccupancyGrid, theirs: OccupancyGrid, options: MatchOptions) -> list[Candidate]:
    """Every transform voted for, with its match factor."""
    pairs = similar_features(paper_features(ours), paper_features(theirs), options.size_tolerance)
    counter = FactorCounter.of(ours, theirs)
    affordable = max(MIN_TRANSLATIONS, round(MAX_CELLS_COUNTED / (2 * MAX_ROTATIONS * max(1, ours.cells.size))))
    candidates = []
    for theta_rad in rotation_candidates(pairs, options.rotation_bin_deg):
        for T_ours_theirs in translation_candidates(pairs, theta_rad, min(MAX_TRANSLATIONS, affordable)):
            candidates.append(Candidate(T_ours_theirs, counter.at(T_ours_theirs)))
    return candidates


def similar_features(ours: PaperFeatures, theirs: PaperFeatures, tolerance: float) -> SimilarFeatures:
    """All pairs of one kind whose sizes differ by at most `tolerance` of the larger."""
    kinds = [
        _alike_in_size(ours.lines, theirs.lines, tolerance),
        _alike_in_size(ours.curves, theirs.curves, tolerance),
        _alike_in_size(ours.circles, theirs.circles, tolerance),
    ]
    directed = np.repeat([True, True, False], [len(mine) for mine, _ in kinds])
    return SimilarFeatures(np.concatenate([m for m, _ in kinds]), np.concatenate([t for _, t in kinds]), directed)


def _alike_in_size(ours: FeatureRows, theirs: FeatureRows, tolerance: float) -> tuple[FeatureRows, FeatureRows]:
    mine, yours = ours[:, None, 2], theirs[None, :, 2]
    i, j = np.nonzero(np.abs(mine - yours) <= tolerance * np.maximum(mine, yours))
    return ours[i], theirs[j]


def rotation_candidates(pairs: SimilarFeatures, bin_deg: float) -> Iterator[float]:
    """Orientation differences, most frequent first; a slope says nothing about direction, so each comes with its opposite."""
    turn_rad = pairs.ours[pairs.directed, 3] - pairs.theirs[pairs.directed, 3]
    bins = np.rint(np.degrees(turn_rad) / bin_deg).astype(np.int64) % round(180 / bin_deg)
    for index in _most_frequent(bins, MAX_ROTATIONS):
        yield math.radians(index * bin_deg)
        yield math.radians(index * bin_deg) + math.pi


def translation_candidates(pairs: SimilarFeatures, theta_rad: float, limit: int = MAX_TRANSLATIONS) -> Iterator[SE2]:
    """Differences of centres once theirs are turned by theta, most frequent first."""
    T_ours_turned = SE2(0.0, 0.0, theta_rad)
    shifts_m = pairs.ours[:, :2] - T_ours_turned.apply(pairs.theirs[:, :2])
    bins = np.rint(shifts_m / TRANSLATION_BIN_M).astype(np.int64)
    for code in _most_frequent(bins[:, 0] * _ROW + bins[:, 1], limit):
        x, y = (code + _ROW // 2) // _ROW, (code + _ROW // 2) % _ROW - _ROW // 2
        yield SE2(x * TRANSLATION_BIN_M, y * TRANSLATION_BIN_M, wrap_angle(theta_rad))


def _most_frequent(votes: NDArray[np.int64], limit: int) -> list[int]:
    """Distinct votes, the most frequent first; among equals the smaller, so that the order of features does not matter."""
    values, counts = np.unique(votes, return_counts=True)
    most: list[int] = values[np.argsort(-counts, kind="stable")][:limit].tolist()
    return most
