"""What matching two maps is asked and what it answers.

`T_ours_theirs` takes points of their map frame to ours.  A result that is not MERGED still carries the best hypothesis and
every number the decision rests on, so that a person can see why, and the fleet can wait for more map.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from protocol.geometry import SE2


class MatchStatus(StrEnum):
    """The three answers."""

    MERGED = "merged"  # this transform, and no other, lays one map on the other
    AMBIGUOUS = "ambiguous"  # it fits, but so does another: keep the alternatives, wait for more map
    NO = "no"  # the maps give no reason to be merged (yet)


class Reason:
    """Reason codes of a result: short, stable, fit for a record or a counter."""

    MATCHED = "matched"
    EMPTY = "empty map"
    NO_CANDIDATES = "no candidates"
    LITTLE_WALL = "little common wall"
    LOW_MATCH_FACTOR = "low match factor"
    CONFLICTS = "walls conflict"
    UNOBSERVABLE = "unobservable direction"
    RIVAL = "second best as good"
    LOOK_ALIKE = "looks like another place of the same kind"


@dataclass(frozen=True, slots=True)
class MatchFactor:
    """Equations (1) to (3): cells that agree and disagree where both maps know something."""

    agree: int
    disagree: int

    @property
    def value(self) -> float:
        known = self.agree + self.disagree
        return self.agree / known if known else 0.0


@dataclass(frozen=True, slots=True)
class MatchOptions:
    """How picky matching is.  The defaults decide for a miss rather than a wrong merge."""

    method: str = "hybrid"  # or "paper": Alnounou et al., literally
    min_match_factor: float = 0.85  # the paper's; true transforms pass it, random ones of fine maps too: necessary, never enough
    size_tolerance: float = 0.15  # paper: two features are "the same size" within this fraction
    rotation_bin_deg: float = 1.0  # paper: resolution of the rotation vote
    min_margin_m: float = 6.5  # metres of wall by which the best must beat the best distinct alternative; 8 costs 5 % of merges
    min_agreeing_m: float = 8.0  # of firm wall
    max_rival_share: float = 0.72  # of the best score
    near_rival_share: float = 0.32  # above it the building may repeat itself: what merges then has no flaw
    some_rival_share: float = 0.15  # above it, the maps must agree in what tells places apart
    min_observability_m: float = 2.0  # of wall that fixes the worst-seen direction, and
    min_observable_share: float = 0.1  # of agreeing wall: along a long corridor two metres of cross wall are an accident
    unsuspicious: float = 0.3  # most true pairs look less like another place of the same kind; above it more margin is asked for
    distinctive_m: float = 12.0  # agreeing short wall and clutter; with less, any suspicion asks for more margin
    mirror_test: bool = True  # try the reflection before merging: 40 ms a merge, and look-alikes in mirror image do not pass
    thorough: bool = True  # a second, slower pass when the first ends undecided


@dataclass(frozen=True, slots=True)
class Alternative:
    """Another transform that was considered to the end."""

    T_ours_theirs: SE2
    score: float


def _unknown_covariance() -> NDArray[np.float64]:
    return np.diag([1e6, 1e6, 10.0])


@dataclass(frozen=True, slots=True, eq=False)
class MergeResult:
    """The best transform found, what speaks for and against it, and the verdict."""

    status: MatchStatus
    T_ours_theirs: SE2 | None  # None: not even a hypothesis
    covariance: NDArray[np.float64] = field(default_factory=_unknown_covariance)  # (3, 3) x, y, theta of T_ours_theirs
    factor: MatchFactor = MatchFactor(0, 0)
    overlap_m2: float = 0.0  # area known to both maps
    score: float = 0.0  # metres of wall for, less metres against
    runner_up_score: float = 0.0  # the same of the best distinct alternative
    candidates_tried: int = 0
    reason: str = Reason.NO_CANDIDATES
    alternatives: tuple[Alternative, ...] = ()
    evidence: Mapping[str, float] = field(default_factory=dict)  # every number the verdict rests on

    @property
    def accepted(self) -> bool:
        return self.status is MatchStatus.MERGED

    @staticmethod
    def none(reason: str) -> MergeResult:
        return MergeResult(MatchStatus.NO, None, reason=reason)

    def inverse(self) -> MergeResult:
        """The same finding told from the other side: their frame gets our points."""
        if self.T_ours_theirs is None:
            return self
        T = self.T_ours_theirs
        return replace(
            self,
            T_ours_theirs=T.inverse(),
            covariance=inverse_covariance(T, self.covariance),
            alternatives=tuple(Alternative(a.T_ours_theirs.inverse(), a.score) for a in self.alternatives),
        )


def inverse_covariance(T: SE2, covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Covariance (x, y, theta) of the inverse of T, to first order."""
    inverse = T.inverse()
    J = np.zeros((3, 3))
    J[:2, :2] = -inverse.rotation()
    J[:2, 2] = (inverse.y_m, -inverse.x_m)
    J[2, 2] = -1.0
    result: NDArray[np.float64] = J @ covariance @ J.T
    return result
