"""The front end: where the robot is now, matched against the best particle's field on every scan.

Cheap while all goes well (Gauss-Newton from the odometry prediction); after a large step, or when the match is poor, it
first asks the coarse field for better places to start from.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent.mapping.correlation import CoarseField
from agent.mapping.likelihood import TiledFields
from agent.mapping.scan_matching import Poses, difference, information, refine, weakest_direction

SURE_FRACTION = 0.75  # mean field value of a match that needs no second look: a wheel that slipped by 9 degrees left 0.64
GOOD_FRACTION = 0.55  # ... and of one that is believed, unless the wheels say that it cannot be
SMALL_STEP_M = 0.15  # below this, odometry lies in the basin of Gauss-Newton
SMALL_STEP_RAD = math.radians(5)
NEAR_REACH = (0.3, math.radians(12))  # search window after a large step
WIDE_REACH = (0.8, math.radians(30))  # when the near window found nothing good
LARGEST_OBJECTION = 15.0  # points of a scan, of which there are some hundred: wheels do slip
STARTS = 4  # coarse peaks that Gauss-Newton is started from


@dataclass(frozen=True, slots=True, eq=False)
class Tracked:
    """The pose that fits, and how well."""

    pose: NDArray[np.float64]  # (3,) T_map_robot
    score: float  # how well it fits, less what odometry holds against it
    fraction: float  # mean field value under the scan, 0 to 1
    likelihood: NDArray[np.float32]  # (M,) field value under every point
    curvature: NDArray[np.float64]  # (3, 3) of the walls alone
    weakest: float  # ratio of weakest to strongest direction
    is_jump: bool  # farther from where the wheels say than they can be wrong, unless they slipped


def track(
    fields: TiledFields,
    particle: int,
    coarse: CoarseField,
    predicted: NDArray[np.float64],
    step: tuple[float, float],
    deviation: tuple[float, float],
    surfels: NDArray[np.float32],
) -> Tracked:
    """The pose near `predicted` that fits best; `step` is how far the robot moved (metres, radians), `deviation` one sigma."""
    weights = information(*deviation)
    reach_m = float(np.hypot(surfels[:, 0], surfels[:, 1]).max()) + 2.0
    fields.cover(predicted[:2] - reach_m, predicted[:2] + reach_m)
    starts = predicted[None]
    best = best_fit(fields, particle, starts, predicted, weights, surfels)
    is_small = step[0] < SMALL_STEP_M and step[1] < SMALL_STEP_RAD
    for reach, enough in ((NEAR_REACH, SURE_FRACTION if is_small else 1.0), (WIDE_REACH, GOOD_FRACTION)):
        if best.fraction >= enough:
            break
        starts, _ = coarse.best_poses(predicted, surfels[:, :2], *reach, STARTS)
        best = better(best, best_fit(fields, particle, starts, predicted, weights, surfels))
    return best


def better(a: Tracked, b: Tracked) -> Tracked:
    return b if b.score > a.score else a


def best_fit(
    fields: TiledFields,
    particle: int,
    starts: Poses,
    predicted: NDArray[np.float64],
    weights: NDArray[np.float64],
    surfels: NDArray[np.float32],
) -> Tracked:
    """Gauss-Newton from every start; the best end."""
    n = len(starts)
    priors = np.broadcast_to(predicted, (n, 3))
    fit = refine(fields, np.full(n, particle), starts, priors, np.broadcast_to(weights, (n, 3, 3)), surfels)
    objections = objected(fit.poses, predicted, weights)
    scores = fit.likelihood.sum(axis=1, dtype=np.float64) - np.minimum(objections, LARGEST_OBJECTION)
    i = int(np.argmax(scores))
    ratio, _ = weakest_direction(fit.curvature[i])
    return Tracked(
        pose=fit.poses[i],
        score=float(scores[i]),
        fraction=float(fit.fractions()[i]),
        likelihood=fit.likelihood[i],
        curvature=fit.curvature[i],
        weakest=ratio,
        is_jump=bool(objections[i] > LARGEST_OBJECTION),
    )


def objected(poses: Poses, predicted: NDArray[np.float64], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """(P,) what odometry holds against each pose, in points that must fit to outweigh it."""
    d = difference(poses, np.broadcast_to(predicted, poses.shape))
    return np.asarray(0.5 * np.einsum("pi,ij,pj->p", d, weights, d))
