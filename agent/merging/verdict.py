"""The verdict on the best transform: for it, against it, and how far ahead of the best other one it is.

Absolute evidence is worth little (two corridors agree over a hundred metres of wall), so the margin over the best distinct
alternative decides first.  The paper's match factor is a gate: true transforms pass it, and look-alikes often do not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent.merging.result import MatchOptions, MatchStatus, Reason
from agent.merging.transforms import Poses, angle_between, applied

SAME_PLACE_M = 0.8  # two transforms that move the middle of their map less than this, and
SAME_TURN_RAD = 0.105  # turn it less than 6 degrees, are one hypothesis
MIN_AGREEING_SHARE = 0.5  # of firm wall that says anything; half is a bar that only vegetation comes near
MIN_YIELD = 0.15  # score per metre it would be without anything against
USUAL_FACTOR = 0.95  # of true transforms at 10 cm
FACTOR_SLOPE = 0.3  # coarser cells disagree more at the truth, by this a metre of cell
MAX_SUSPICION = 1.4  # true pairs of bent maps reach 1.6
MARGIN_PER_SUSPICION_M = 6.5
MARGIN_PER_BARE_SUSPICION_M = 12.0  # where little else than long walls agrees: ends of a plan merged wrongly up to 11 a unit
GRAVE_SUSPICION = 0.85  # few true pairs look worse, and those that do are far ahead of any rival;
MARGIN_PER_GRAVE_SUSPICION_M = 70.0  # two warehouses at 1.2 were ahead by 29 m, mirrored parts of a building by 20
MIN_DISTINCT_M = 4.0  # two ends of a building share long walls; what tells them apart is short,
CLEAR_MARGIN_M = 25.0  # unless nothing else comes near: ends that were merged wrongly were ahead by 7 to 13 m
FLAWED_SHARE, FLAW = 0.45, 0.002  # a rival of this share of the score, and of `deep_doubt` more than none
ODD_M, ODD_MARGIN_M = 1.5, 40.0  # in the middle of free space; classrooms that were merged wrongly were ahead by up to 29 m
INDOOR_SHARE = 0.4  # of what agrees is more than there is of loose things; in the open these come and go
DEEP_ALONE = 2.0  # doubt per root of `deep_doubt`; true pairs keep their margins up to 2.2
STRETCH_M, STRETCH_SHARE = 3.0, 0.06  # of one wall in the open: true pairs reach 0.065 of what agrees among cars,
STRETCH_PER_ASTRAY = 0.25  # and 0.105 among plants, where things astray tell that little fits better
STRANGE_M, FAMILIAR_M = 1.0, 1.0  # things that stand elsewhere, and things that stand where they should
MIN_TURNING_M = 2.0  # of wall that says how the maps are turned: less is an accident, true pairs have 2.9 and more
ROUND_M = 16.0  # so much wall, of which
ROUND_SHARE = 0.28  # less than this says how the maps are turned, is a round hall or racking: its ends merged up to 0.27
BLURRED_M, BLURRED = 0.07, 2.75  # no true pair has small things so far off, and so much farther than long walls, unless it is
BLURRED_MARGIN_M = 60.0  # this far ahead; desks of other classrooms are off by 9 to 11 cm, 3.6 to 4.2 times as far as the walls
ANYHOW_M = 0.1  # small things this far off, indoors: true pairs with a rival and without a clear margin stay below 0.09
ACCIDENT_M = 0.105  # long walls of grave suspicion this far off lie on others: by accident 0.14, true ones 0.10 at most
REPEATED_SHARE, REPEATED_M = 0.6, 24.0  # a rival of this share of the score and so much wall is no accident


@dataclass(frozen=True, slots=True)
class Grounds:
    """Every number the verdict rests on; metres of wall, the mean of both directions."""

    score: float
    rival: float  # best score of a distinct alternative
    agreeing_m: float  # firm wall
    against_m: float  # firm wall that conflicts or crosses
    potential_m: float  # the score were there nothing against it
    observability_m: float
    factor: float
    cell_m: float
    attached_doubt: float
    deep_doubt: float
    distinct_m: float  # agreeing wall that is no long wall
    stretch_m: float  # the most of one long wall that stands deep in the other map's free space
    loose_m: float  # free-standing things that agree,
    astray_m: float  # and those deep in the other map's free space
    turning_m: float  # agreeing wall that says how the maps are turned
    long_error_m: float  # how far long walls that agree lie apart,
    small_error_m: float  # and what is no long wall

    @property
    def suspicion(self) -> float:
        """How much this looks like another place of the same kind.

        A building laid on its own mirror image agrees over a hundred metres of wall without any rival.  What gives it away is
        what a building does not repeat: small things along the walls, straight walls deep in free space, and the match
        factor.  The weights are those that tell mirrored recordings from true pairs; the optimum is flat.
        """
        factor = self.factor + FACTOR_SLOPE * max(0.0, self.cell_m - 0.1)
        return 13.0 * (USUAL_FACTOR - factor) + math.sqrt(min(self.attached_doubt, 0.5)) + 1.6 * math.sqrt(self.deep_doubt)

    @property
    def deep_m(self) -> float:
        """Straight wall deep in the other map's free space."""
        return self.deep_doubt * self.agreeing_m

    @property
    def is_indoors(self) -> bool:
        """Whether little of what there is stands free: in the open things come and go."""
        return self.loose_m + self.astray_m < INDOOR_SHARE * self.agreeing_m

    @property
    def is_refuted(self) -> bool:
        """Whether no margin could get this merged."""
        return self.suspicion > MAX_SUSPICION

    def is_clear(self, options: MatchOptions) -> bool:
        """Whether nothing is doubtful here, and more than long walls agrees."""
        return self.suspicion < options.unsuspicious and self.distinct_m >= MIN_DISTINCT_M

    def numbers(self) -> dict[str, float]:
        return {name: float(getattr(self, name)) for name in (*self.__slots__, "suspicion")}


def verdict(grounds: Grounds, options: MatchOptions) -> tuple[MatchStatus, str]:
    """The answer and its reason."""
    g = grounds
    if g.agreeing_m <= options.min_agreeing_m or g.score <= options.min_margin_m:
        return MatchStatus.NO, Reason.LITTLE_WALL
    if g.agreeing_m <= MIN_AGREEING_SHARE * (g.agreeing_m + g.against_m) or g.score <= MIN_YIELD * g.potential_m:
        return MatchStatus.NO, Reason.CONFLICTS
    if g.factor < options.min_match_factor:
        return MatchStatus.NO, Reason.LOW_MATCH_FACTOR
    is_fixed = g.observability_m > max(options.min_observability_m, options.min_observable_share * g.agreeing_m)
    if not is_fixed or g.turning_m < MIN_TURNING_M:
        return MatchStatus.AMBIGUOUS, Reason.UNOBSERVABLE
    if g.score - g.rival <= _needed_margin_m(g, options) or g.rival >= options.max_rival_share * g.score:
        return MatchStatus.AMBIGUOUS, Reason.RIVAL
    is_bare = g.distinct_m < MIN_DISTINCT_M and g.score - g.rival < CLEAR_MARGIN_M
    grave_m = options.min_margin_m + MARGIN_PER_GRAVE_SUSPICION_M * (g.suspicion - GRAVE_SUSPICION)
    is_doubtful = g.is_refuted or is_bare or g.score - g.rival <= grave_m or _is_crossed(g) or _is_blurred(g)
    if is_doubtful or _is_one_of_many(g, options) or _is_one_of_a_few(g, options):
        return MatchStatus.AMBIGUOUS, Reason.LOOK_ALIKE
    return MatchStatus.MERGED, Reason.MATCHED


def _is_crossed(g: Grounds) -> bool:
    """Whether a wall of one map crosses the other's free space, longer than a door: two warehouses with the same racks."""
    return g.stretch_m > max(STRETCH_M, STRETCH_SHARE * g.agreeing_m + STRETCH_PER_ASTRAY * g.astray_m)


def _is_blurred(g: Grounds) -> bool:
    """Whether things lie on things like them, not on the same: small ones far less sharply than long walls, or long walls too."""
    bar_m = max(BLURRED_M, BLURRED * g.long_error_m)
    is_like = g.small_error_m > bar_m and g.score - g.rival < BLURRED_MARGIN_M
    return is_like or (g.long_error_m > ACCIDENT_M and g.suspicion > GRAVE_SUSPICION)


def _is_one_of_many(g: Grounds, options: MatchOptions) -> bool:
    """Whether the building repeats what agrees here, so that the best place may be as wrong as the second best.

    Two ends of a hotel with one kind of room fit over fifty metres of wall, shifted by a room nearly as well.  A true overlap
    with a rival so near is flawless, as a rule; a wrong one has some furniture in the middle of the other map's free space.
    """
    share = g.rival / g.score
    if share <= options.near_rival_share:
        return False
    is_odd = g.astray_m + g.deep_m > ODD_M and g.score - g.rival < ODD_MARGIN_M
    is_flawed = (g.is_indoors and is_odd) or (share > FLAWED_SHARE and g.deep_doubt > FLAW)
    return is_flawed or (share > REPEATED_SHARE and g.rival > REPEATED_M)


def _is_one_of_a_few(g: Grounds, options: MatchOptions) -> bool:
    """Whether there is some other place, and what would tell it from this one does not agree.

    Two ends of a rotunda agree along its round walls, however they are turned, and walls between its rooms fall on each other
    by accident.  Two of its rooms agree in every wall, and in nothing that stands in them.  Cars in two ends of a garage
    stand beside each other, as near as accident puts them, or a wall where there is none.
    """
    if g.rival <= options.some_rival_share * g.score:
        return False
    is_round = g.agreeing_m >= ROUND_M and g.turning_m <= ROUND_SHARE * g.agreeing_m
    is_odd = g.is_indoors and (g.deep_m > ODD_M or g.small_error_m > ANYHOW_M)
    is_clear = g.score - g.rival >= CLEAR_MARGIN_M
    return (not is_clear and (is_round or is_odd)) or (g.astray_m > STRANGE_M and g.loose_m < FAMILIAR_M)


def _needed_margin_m(g: Grounds, options: MatchOptions) -> float:
    """More the more it looks like another place of the same kind.

    Two ends of one building share long walls by design, and a few metres of cross wall by accident.  Where short walls and
    clutter do not outweigh that accident, every doubt counts in full, and a high match factor, which wide space has anywhere,
    excuses no wall deep in it.
    """
    if g.distinct_m >= options.distinctive_m:
        return options.min_margin_m + MARGIN_PER_SUSPICION_M * max(0.0, g.suspicion - options.unsuspicious)
    doubt = max(0.0, g.suspicion, DEEP_ALONE * math.sqrt(g.deep_doubt))
    return options.min_margin_m + MARGIN_PER_BARE_SUSPICION_M * doubt


def rival_score(poses: Poses, scores: NDArray[np.float64], best: int, around_m: NDArray[np.float64]) -> float:
    """Score of the best transform that means something else; zero when there is none."""
    apart = elsewhere(poses, best, around_m)
    return max(0.0, float(scores[apart].max())) if apart.any() else 0.0


def elsewhere(poses: Poses, best: int, around_m: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(C,) which transforms mean something else than this one."""
    place = applied(poses, around_m)
    apart = np.hypot(*(place - place[best]).T) > SAME_PLACE_M
    apart |= angle_between(poses[:, 2], float(poses[best, 2])) > SAME_TURN_RAD
    return np.asarray(apart)
