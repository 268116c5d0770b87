"""When the scans of a log were taken: by its stamps, if these can be true.

A log may bear two clocks, the driver's and the logger's, and both may be none: all zero, printed with so few digits that a whole
drive takes no time, or set back in the middle.  A metre within no time is no motion that anybody would believe, so such a log
gets the stamps of a robot that drives at an ordinary speed.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from itertools import accumulate

from protocol.geometry import SE2

CRUISE_M_S, CRUISE_RAD_S = 0.5, 0.8  # of a robot whose logger had no clock
LEAST_S = 0.02  # between two scans of a robot that stands
FASTEST = 6.0  # times as fast as that on the average: the clock is none
STANDING = 0.2  # of the way may be driven while the clock stands: stamps are late, and some out of order
SET_BACK_S = 5.0  # further back than any logger writes out of order


def seconds_of(clocks: Sequence[Sequence[float]], motions: Sequence[SE2 | None]) -> list[float]:
    """Since the first scan, by the first of the clocks that can be believed, else by the way."""
    way_s = [_seconds(motion or SE2.identity()) for motion in motions]
    for clock in clocks:
        stamps_s = _never_set_back([stamp_s - clock[0] for stamp_s in clock], way_s)
        if _runs(stamps_s, way_s):
            return stamps_s
    return list(accumulate((max(taken_s, LEAST_S) for taken_s in way_s[1:]), initial=0.0))


def _seconds(motion: SE2) -> float:
    return math.hypot(motion.x_m, motion.y_m) / CRUISE_M_S + abs(motion.theta_rad) / CRUISE_RAD_S


def _runs(stamps_s: list[float], way_s: list[float]) -> bool:
    steps = [(b - a, taken_s) for (a, b), taken_s in zip(itertools.pairwise(stamps_s), way_s[1:], strict=True)]
    in_no_time_s = sum(taken_s for step_s, taken_s in steps if step_s <= 0)
    return stamps_s[-1] * FASTEST >= sum(way_s) and in_no_time_s <= STANDING * sum(way_s)


def _never_set_back(stamps_s: list[float], way_s: list[float]) -> list[float]:
    """The same stamps; after a clock was set back, as late as the way to there took."""
    steps_s = [b - a for a, b in itertools.pairwise(stamps_s)]
    if min(steps_s, default=0.0) > -SET_BACK_S:
        return stamps_s
    mended = (step_s if step_s > -SET_BACK_S else taken_s for step_s, taken_s in zip(steps_s, way_s[1:], strict=True))
    return list(accumulate(mended, initial=0.0))
