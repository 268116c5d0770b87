"""The Rao-Blackwellized particle filter: many guesses of the path, each with its own map.

Follows Grisetti, Stachniss and Burgard (2007) in its idea, not in its arithmetic: every particle's scan match is the mode
of its proposal, and all particles are matched in the same few array operations.

    for each keyframe:  move every particle by the tracked motion          (shared front end, tracking.py)
                        refine every particle in its own field             (scan_matching.refine, batched)
                        draw from the refined mode, weigh by likelihood    (gain 0.03: beams are far from independent)
                        stamp the scan into every particle's field         (likelihood.py)
                        resample when the effective number falls below half, or when the spread asks for more

There are as many particles as the robot's place is in doubt (the idea of Fox's KLD-sampling, 2003): twice the usual number
after a long way through the unknown, a third of it where they stand on one spot.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from agent.mapping.likelihood import TiledFields
from agent.mapping.packed_rows import PackedRows
from agent.mapping.scan_matching import Fit, Poses, information, placed, refine

FIELD_SIGMA_M = 0.06  # 0.1 lost one building on every seed, 0.04 falls out of the basin of Gauss-Newton
RANDOM_HIT = 0.05  # share of beams that nothing on the map explains
WEIGHT_GAIN = 0.03  # of each point's log-likelihood; stronger gains kill the right particle on one noisy scan
SPREAD_GAIN = 0.02  # of the fit's covariance, when drawing around the mode
PREDICTION_NOISE = np.array([0.01, 0.01, 0.004])  # metres, metres, radians: what keeps the particles apart
CLEARLY_LIKELIER = 1.0  # in log-weight: the drawn map should not flip between particles that are as good
AGREED_EVERY = 64  # keyframes: then the path that all particles share is fixed, and only the followed one kept
KEPT_KEYFRAMES = 2048  # ... and half of this, 300 metres of way, when they still do not agree
RESAMPLE_BELOW = 0.5  # effective particles, as a share of all
USUAL_SPREAD_M = 0.05  # one sigma of where the particles stand, above which more than the usual number are wanted
SETTLED_M = 0.01  # ... and below which fewer will do; at 0.05, freiburg-079 was lost on two seeds of eight
FEWEST, MOST = 1 / 3, 2.0  # of the usual number
GROW_ABOVE = 1.5  # times as many wanted as there are: do not wait for the weights
MOST_PARTICLES = 2000  # whatever was asked for

Numbers = NDArray[np.uint16]
NO_POSES, NO_NUMBERS = np.empty((0, 3)), np.empty(0, np.uint16)


class ParticleFilter:
    """(N,) poses with weights, a likelihood field each, and the tree of their paths."""

    def __init__(self, particles: int, resolution_m: float, rng: np.random.Generator) -> None:
        self.rng = rng
        self.usual_particles = particles
        self.fields = TiledFields(particles, resolution_m, FIELD_SIGMA_M)
        self.poses: Poses = np.zeros((particles, 3))  # T_map_robot of every particle
        self.log_weights = np.zeros(particles)
        self.path = PackedRows(NO_POSES)  # poses at every keyframe so far
        self.parents = PackedRows(NO_NUMBERS)  # particle i of keyframe k came from particle parents[k][i] of k - 1
        self.next_parents: Numbers = np.arange(particles, dtype=np.uint16)
        self.followed = 0  # the particle that is tracked and drawn
        self.lineage: list[int] = []  # its ancestor at every keyframe of the path ...
        self.line: Poses = np.empty((0, 3))  # ... and where that one was, at every keyframe of all
        self.forgotten = 0  # keyframe number of path[0]: nobody turns back further than that

    @property
    def particles(self) -> int:
        return len(self.poses)

    def effective_particles(self) -> float:
        weights = self.weights()
        return float(1.0 / np.sum(weights**2))

    def weights(self) -> NDArray[np.float64]:
        weights = np.exp(self.log_weights - self.log_weights.max())
        return np.asarray(weights / weights.sum())

    def start(self, surface_m: NDArray[np.float32]) -> None:
        """The first keyframe: every particle stands at its pose and draws the same scan."""
        self._cover(surface_m)
        self._stamp(surface_m)
        self._remember()
        self._follow()

    def update(
        self,
        motion: NDArray[np.float64],
        deviation: tuple[float, float],
        surfels: NDArray[np.float32],
        surface_m: NDArray[np.float32],
    ) -> Fit:
        """One keyframe: motion (3,) in the robot frame since the last one, one sigma of it, points to match and to draw."""
        predicted = moved(self.poses, motion)
        noise = self.rng.standard_normal((self.particles, 3)) * PREDICTION_NOISE
        noise[0] = 0.0  # one particle follows the tracked motion exactly
        self.poses = predicted + noise
        self._cover(surface_m)
        everyone = np.arange(self.particles)
        prior = np.broadcast_to(information(*deviation), (self.particles, 3, 3))
        fit = refine(self.fields, everyone, self.poses, predicted, prior, surfels)
        self.poses = fit.poses + self._spread(fit, prior)
        self._weigh(fit)
        self._stamp(surface_m)
        self._remember()
        self._resample_when_needed()
        self._follow()
        return fit

    def _spread(self, fit: Fit, prior: NDArray[np.float64]) -> Poses:
        """Small steps around each mode, as wide as the fit is soft; none for the best particle."""
        covariance = SPREAD_GAIN * np.linalg.inv(fit.curvature + prior)
        steps = np.einsum("pij,pj->pi", np.linalg.cholesky(covariance), self.rng.standard_normal((self.particles, 3)))
        steps[np.argmax(self.log_weights)] = 0.0
        return np.asarray(steps)

    def _weigh(self, fit: Fit) -> None:
        likelihood = np.log((1.0 - RANDOM_HIT) * fit.likelihood + RANDOM_HIT).sum(axis=1, dtype=np.float64)
        self.log_weights += WEIGHT_GAIN * likelihood
        self.log_weights -= self.log_weights.max()

    def _cover(self, points_m: NDArray[np.float32]) -> None:
        reach_m = float(np.sqrt((points_m**2).sum(axis=1).max())) + 1.0
        self.fields.cover(self.poses[:, :2].min(axis=0) - reach_m, self.poses[:, :2].max(axis=0) + reach_m)

    def _stamp(self, points_m: NDArray[np.float32]) -> None:
        x, y, _, _ = placed(self.poses, points_m)
        self.fields.stamp(x, y)

    def _remember(self) -> None:
        self.path.append(self.poses)
        self.parents.append(self.next_parents)
        self.next_parents = np.arange(self.particles, dtype=np.uint16)

    def _resample_when_needed(self) -> None:
        wanted = wanted_particles(self.poses, self.weights(), self.usual_particles)
        is_uneven = self.effective_particles() < RESAMPLE_BELOW * self.particles
        if not is_uneven and wanted < GROW_ABOVE * self.particles:
            return
        ancestors = systematic(self.weights(), self.rng.random(), wanted)
        self.followed = heir(ancestors, self.followed)
        self.poses = self.poses[ancestors]
        self.fields.resample(ancestors)
        self.log_weights = np.zeros(self.particles)
        self.next_parents = ancestors.astype(np.uint16)

    def _follow(self) -> None:
        """Stay with the followed particle while none is clearly likelier, and keep its lineage."""
        best = int(np.argmax(self.log_weights))
        if self.log_weights[best] > self.log_weights[self.followed] + CLEARLY_LIKELIER:
            self.followed = best
        particle = int(self.next_parents[self.followed])
        self.lineage.append(particle)
        self.line = np.vstack([self.line, self.path[-1][particle]])
        for k in range(len(self.path) - 2, -1, -1):
            particle = int(self.parents[k + 1][particle])
            if self.lineage[k] == particle:
                break
            self.lineage[k] = particle
            self.line[k + self.forgotten] = self.path[k][particle]
        if len(self.line) % AGREED_EVERY == 0:
            self._forget(self._agreed())
        if len(self.path) > KEPT_KEYFRAMES:
            self._forget(KEPT_KEYFRAMES // 2)

    def _agreed(self) -> int:
        """How many keyframes lie before the newest one at which all particles have the same ancestor."""
        ancestors = np.unique(self.next_parents)
        for k in range(len(self.path) - 1, 0, -1):
            if len(ancestors) == 1:
                return k
            ancestors = np.unique(self.parents[k][ancestors])
        return 0

    def _forget(self, keyframes: int) -> None:
        self.path.drop(keyframes)
        self.parents.drop(keyframes)
        del self.lineage[:keyframes]
        self.forgotten += keyframes

    def adopt(self, line: Poses, field: TiledFields) -> None:
        """A loop was closed: `line` (K, 3) is what everybody remembers now, and `field`, of one particle, what they see."""
        correction = composed(line[-1:], inverted(self.line[-1:]))
        self.poses = composed(np.repeat(correction, self.particles, axis=0), self.poses)
        self.line = line.copy()
        self.path = PackedRows(NO_POSES, (pose[None] for pose in line[self.forgotten :]))
        self.parents = PackedRows(NO_NUMBERS, (np.zeros(1, np.uint16) for _ in self.path))
        self.next_parents = np.zeros(self.particles, np.uint16)
        self.lineage = [0] * len(self.path)
        self.fields.put(np.repeat(field.tables, self.particles, axis=0), field.pool, field.first_tile)


def composed(a: Poses, b: Poses) -> Poses:
    """(P, 3) poses b, each in the frame of its a."""
    out = moved(a, b)
    out[:, 2] = (out[:, 2] + np.pi) % (2.0 * np.pi) - np.pi
    return out


def inverted(poses: Poses) -> Poses:
    """(P, 3) the frames they stand in, seen from each."""
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    x, y = poses[:, 0], poses[:, 1]
    return np.stack([-cos * x - sin * y, sin * x - cos * y, -poses[:, 2]], axis=1)


def moved(poses: Poses, motion: NDArray[np.float64]) -> Poses:
    """(P, 3) poses, each moved by (3,) or (P, 3) in its own frame."""
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    out = poses.copy()
    out[:, 0] += cos * motion[..., 0] - sin * motion[..., 1]
    out[:, 1] += sin * motion[..., 0] + cos * motion[..., 1]
    out[:, 2] += motion[..., 2]
    return out


def heir(ancestors: NDArray[np.int64], particle: int) -> int:
    """The first copy of a particle among the resampled, or of the next one that lived on."""
    return min(int(np.searchsorted(ancestors, particle)), len(ancestors) - 1)


def wanted_particles(poses: Poses, weights: NDArray[np.float64], usual: int) -> int:
    """How many particles their spread calls for; grows with its square root, so that neither limit comes soon."""
    away_m = poses[:, :2] - weights @ poses[:, :2]
    spread_m = float(np.sqrt(weights @ (away_m**2).sum(axis=1)))
    more, fewer = math.sqrt(spread_m / USUAL_SPREAD_M), math.sqrt(spread_m / SETTLED_M)
    share = max(min(fewer, 1.0), min(more, MOST), FEWEST)
    return min(max(round(usual * share), 1), MOST_PARTICLES)


def systematic(weights: NDArray[np.float64], offset: float, n: int) -> NDArray[np.int64]:
    """Low-variance resampling: n evenly spaced pointers, one random offset in [0, 1)."""
    pointers = (np.arange(n) + offset) / n
    return np.minimum(np.searchsorted(np.cumsum(weights), pointers), len(weights) - 1)
