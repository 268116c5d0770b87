"""The verdict on grounds that miss one thing each."""

from __future__ import annotations

from dataclasses import replace

import pytest

from agent.merging.result import MatchOptions, MatchStatus, Reason
from agent.merging.verdict import Grounds, verdict

GOOD = Grounds(
    score=40.0,
    rival=5.0,
    agreeing_m=50.0,
    against_m=5.0,
    potential_m=45.0,
    observability_m=15.0,
    factor=0.97,
    cell_m=0.1,
    attached_doubt=0.05,
    deep_doubt=0.01,
    distinct_m=20.0,
    stretch_m=0.0,
    loose_m=5.0,
    astray_m=0.5,
    turning_m=20.0,
    long_error_m=0.04,
    small_error_m=0.05,
)
# what two parts of a building had to say for each other, one of them turned over
MIRRORED_PARTS = {"score": 22.6, "rival": 2.6, "factor": 0.94, "attached_doubt": 0.29, "deep_doubt": 0.08}

# two ends of a hotel whose rooms are all alike, and a corridor where the second best comes as near to a true overlap
HOTEL = {
    "score": 53.7,
    "rival": 36.2,
    "agreeing_m": 65.7,
    "against_m": 1.7,
    "potential_m": 58.7,
    "factor": 0.945,
    "deep_doubt": 0.005,
}
CORRIDOR = {"score": 21.5, "rival": 14.9, "agreeing_m": 25.9, "against_m": 0.2, "potential_m": 22.7, "deep_doubt": 0.0}
# two ends of a rotunda, and of a building of which as little says how it is turned, without a rival
ROTUNDA = {
    "score": 21.9,
    "rival": 7.6,
    "agreeing_m": 30.1,
    "against_m": 0.4,
    "potential_m": 24.0,
    "factor": 0.99,
    "distinct_m": 9.2,
    "deep_doubt": 0.0,
    "turning_m": 6.0,
}
# two warehouses whose racks are the same distances apart, and two ends of one
WAREHOUSES = {
    "score": 52.0,
    "rival": 13.9,
    "agreeing_m": 142.2,
    "against_m": 34.2,
    "potential_m": 102.9,
    "factor": 0.96,
    "attached_doubt": 0.24,
    "deep_doubt": 0.17,
    "distinct_m": 23.4,
    "stretch_m": 16.8,
    "astray_m": 4.4,
}
ALIKE = {
    "score": 34.2,
    "rival": 5.6,
    "agreeing_m": 131.0,
    "against_m": 45.8,
    "factor": 0.957,
    "attached_doubt": 0.81,
    "deep_doubt": 0.13,
}
RACKS = {
    "score": 15.0,
    "rival": 2.75,
    "agreeing_m": 23.3,
    "factor": 0.98,
    "attached_doubt": 0.0,
    "deep_doubt": 0.094,
    "distinct_m": 6.0,
}
# two rooms of one rotunda, furnished each in its own way, and two classrooms
ROOMS = {"score": 18.6, "rival": 7.1, "agreeing_m": 27.4, "deep_doubt": 0.0, "loose_m": 0.3, "astray_m": 1.3}
CLASSROOMS = {"score": 41.0, "rival": 20.65, "deep_doubt": 0.0, "loose_m": 14.4, "astray_m": 2.0}
# desks beside desks, while the long walls lie on each other; and long walls that do not, of a map that is turned over
CARS = {
    "score": 25.6,
    "rival": 5.2,
    "agreeing_m": 35.9,
    "loose_m": 2.8,
    "astray_m": 0.2,
    "small_error_m": 0.108,
    "long_error_m": 0.077,
}
DESKS = {"score": 47.1, "rival": 13.4, "long_error_m": 0.028, "small_error_m": 0.104}
BESIDE = {"factor": 0.93, "attached_doubt": 0.2, "deep_doubt": 0.05, "long_error_m": 0.126}


def test_good_grounds_merge() -> None:
    assert verdict(GOOD, MatchOptions()) == (MatchStatus.MERGED, Reason.MATCHED)


def test_long_walls_alone_merge_when_no_rival_comes_near() -> None:
    assert verdict(replace(GOOD, distinct_m=3.5), MatchOptions()) == (MatchStatus.MERGED, Reason.MATCHED)


def test_a_near_rival_does_not_hurt_what_is_flawless() -> None:
    assert verdict(replace(GOOD, rival=20.0, deep_doubt=0.0), MatchOptions()) == (MatchStatus.MERGED, Reason.MATCHED)
    assert verdict(replace(GOOD, **CORRIDOR), MatchOptions()) == (MatchStatus.MERGED, Reason.MATCHED)


@pytest.mark.parametrize(
    "change",
    [
        WAREHOUSES | {"stretch_m": 8.0},  # a gate, a lorry
        WAREHOUSES | {"astray_m": 40.0},  # a park
        RACKS | {"deep_doubt": 0.05},
        ROOMS | {"loose_m": 2.0},
        CLASSROOMS | {"astray_m": 1.0},
        CLASSROOMS | {"loose_m": 30.0},  # a park
        CLASSROOMS | {"rival": 12.5},
        CLASSROOMS | {"score": 60.7},
        DESKS | {"small_error_m": 0.075},
        CARS | {"small_error_m": 0.09},
        CARS | {"rival": 3.5},  # no other place
        CARS | {"score": 31.0},
        CARS | {"loose_m": 15.0},  # a park
        DESKS | {"long_error_m": 0.04},  # a bent map
        DESKS | {"score": 80.0},
        BESIDE | {"long_error_m": 0.09},
        BESIDE | {"factor": 0.96},
    ],
)
def test_what_changes_in_a_place_does_not_hurt(change: dict[str, float]) -> None:
    assert verdict(replace(GOOD, **change), MatchOptions()) == (MatchStatus.MERGED, Reason.MATCHED)


def test_what_hardly_says_how_it_is_turned_merges_without_a_rival() -> None:
    assert verdict(replace(GOOD, **(ROTUNDA | {"rival": 3.0})), MatchOptions()) == (MatchStatus.MERGED, Reason.MATCHED)
    assert verdict(replace(GOOD, **(ROTUNDA | {"turning_m": 10.0})), MatchOptions()) == (MatchStatus.MERGED, Reason.MATCHED)


def test_little_but_long_walls_must_be_less_suspicious() -> None:
    doubtful = replace(GOOD, score=18.0, factor=0.91, agreeing_m=20.0, against_m=2.0)
    assert verdict(doubtful, MatchOptions()) == (MatchStatus.MERGED, Reason.MATCHED)
    assert verdict(replace(doubtful, distinct_m=9.0), MatchOptions()) == (MatchStatus.AMBIGUOUS, Reason.RIVAL)


@pytest.mark.parametrize(
    ("change", "status", "reason"),
    [
        ({"agreeing_m": 7.0}, MatchStatus.NO, Reason.LITTLE_WALL),
        ({"score": 6.0}, MatchStatus.NO, Reason.LITTLE_WALL),
        ({"against_m": 60.0}, MatchStatus.NO, Reason.CONFLICTS),
        ({"factor": 0.84}, MatchStatus.NO, Reason.LOW_MATCH_FACTOR),
        ({"observability_m": 1.5}, MatchStatus.AMBIGUOUS, Reason.UNOBSERVABLE),
        ({"observability_m": 4.0}, MatchStatus.AMBIGUOUS, Reason.UNOBSERVABLE),
        ({"turning_m": 0.8}, MatchStatus.AMBIGUOUS, Reason.UNOBSERVABLE),
        ({"rival": 35.0}, MatchStatus.AMBIGUOUS, Reason.RIVAL),
        ({"rival": 30.0}, MatchStatus.AMBIGUOUS, Reason.RIVAL),
        ({"distinct_m": 3.5, "score": 24.0}, MatchStatus.AMBIGUOUS, Reason.LOOK_ALIKE),
        ({"factor": 0.88, "attached_doubt": 0.6, "deep_doubt": 0.05}, MatchStatus.AMBIGUOUS, Reason.LOOK_ALIKE),
        ({"rival": 20.0}, MatchStatus.AMBIGUOUS, Reason.LOOK_ALIKE),
        ({"rival": 26.0, "deep_doubt": 0.0}, MatchStatus.AMBIGUOUS, Reason.LOOK_ALIKE),
        (ROTUNDA, MatchStatus.AMBIGUOUS, Reason.LOOK_ALIKE),
        (WAREHOUSES, MatchStatus.AMBIGUOUS, Reason.LOOK_ALIKE),
        (ALIKE, MatchStatus.AMBIGUOUS, Reason.LOOK_ALIKE),
        (RACKS, MatchStatus.AMBIGUOUS, Reason.RIVAL),
        (ROOMS, MatchStatus.AMBIGUOUS, Reason.LOOK_ALIKE),
        (CLASSROOMS, MatchStatus.AMBIGUOUS, Reason.LOOK_ALIKE),
        (CARS, MatchStatus.AMBIGUOUS, Reason.LOOK_ALIKE),
        (CARS | {"small_error_m": 0.05, "deep_doubt": 0.05}, MatchStatus.AMBIGUOUS, Reason.LOOK_ALIKE),
        (DESKS, MatchStatus.AMBIGUOUS, Reason.LOOK_ALIKE),
        (BESIDE, MatchStatus.AMBIGUOUS, Reason.LOOK_ALIKE),
        (HOTEL, MatchStatus.AMBIGUOUS, Reason.LOOK_ALIKE),
        (MIRRORED_PARTS, MatchStatus.AMBIGUOUS, Reason.LOOK_ALIKE),
    ],
)
def test_one_thing_missing_does_not(change: dict[str, float], status: MatchStatus, reason: str) -> None:
    assert verdict(replace(GOOD, **change), MatchOptions()) == (status, reason)
