"""What the demo's fleet made, held against the world it was simulated in."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from protocol.geometry import SE2
from protocol.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

STEPS = ((0.05, math.radians(0.5)), (0.01, math.radians(0.1)), (0.002, math.radians(0.02)))  # metres, radians: coarse to fine
ROUNDS = 12  # of one step of the search each
ALL_TOLD = 6  # of more than these the closing sentence says the least and the most


@dataclass(frozen=True, slots=True)
class Figures:
    """Everything the closing sentence says."""

    robots: Sequence[str]
    merged: Sequence[str]  # members of the global map that is compared here
    seconds_to_merge: float | None  # from all robots being up to one map of all of them
    match_factors: Sequence[float]  # of the live edges
    known_m2: float
    conflicting_cells: int
    agreement: float | None  # share of known cells that are as in the world; None: no truth (a recording)
    pose_errors_m: Mapping[str, float] = field(default_factory=dict)
    scans: int = 0  # of all robots
    scans_lost: int = 0  # came faster than a mapper could follow

    @property
    def are_all_merged(self) -> bool:
        return len(self.robots) > 1 and set(self.merged) >= set(self.robots)

    def sentence(self) -> str:
        """One sentence with the figures."""
        if not self.are_all_merged:
            which = f"only {', '.join(self.merged)}" if len(self.merged) > 1 else "none"
            return f"not merged: of {len(self.robots)} robots {which} found out how their maps fit"
        when = f" after {self.seconds_to_merge:.1f} s" if self.seconds_to_merge is not None else ""
        parts = [f"{len(self.merged)} robots merged into one map of {self.known_m2:.0f} m²{when} ({self._factors()})"]
        if self.agreement is not None:
            parts.append(f"{self.agreement:.1%} of its cells agree with the simulated world")
        if self.pose_errors_m:
            parts.append(self._pose_errors())
        parts.append(f"{self.conflicting_cells} cells conflict and are unknown")
        return "; ".join(parts)

    def _factors(self) -> str:
        factors = sorted(self.match_factors, reverse=True)
        if len(factors) <= ALL_TOLD:
            return f"match factors {', '.join(f'{factor:.3f}' for factor in factors)}"
        return f"{len(factors)} match factors from {factors[-1]:.3f} to {factors[0]:.3f}"

    def _pose_errors(self) -> str:
        errors = sorted(self.pose_errors_m.items())
        if len(errors) <= ALL_TOLD:
            return f"pose errors {', '.join(f'{robot} {error * 100:.1f} cm' for robot, error in errors)}"
        robot, worst_m = max(errors, key=lambda entry: entry[1])
        middle_m = float(np.median([error for _, error in errors]))
        return f"pose errors {100 * middle_m:.1f} cm in the middle, at most {100 * worst_m:.1f} cm ({robot})"


def aligned(fused: OccupancyGrid, truth: OccupancyGrid, T_world_global: SE2) -> SE2:
    """The guess, refined until the map's walls lie best on the world's: where a map's origin sits is nobody's error."""
    distance_m = distance_to_wall_m(truth)
    walls_m = fused.points_of(np.argwhere(fused.cells == OCCUPIED)[:: max(1, int((fused.cells == OCCUPIED).sum()) // 4000)])
    if not len(walls_m):
        return T_world_global
    best, best_cost = T_world_global, cost(walls_m, T_world_global, truth, distance_m)
    for step_m, step_rad in STEPS:
        for _ in range(ROUNDS):
            moves = [SE2(dx, dy, 0.0) for dx in (-step_m, 0.0, step_m) for dy in (-step_m, 0.0, step_m)]
            turns = [SE2(0.0, 0.0, -step_rad), SE2(0.0, 0.0, step_rad)]
            neighbours = [move @ best for move in moves] + [best @ turn for turn in turns]
            tried = [(cost(walls_m, T, truth, distance_m), T) for T in neighbours]
            winner_cost, winner = min(tried, key=lambda entry: entry[0])
            if winner_cost >= best_cost:
                break
            best, best_cost = winner, winner_cost
    return best


def distance_to_wall_m(truth: OccupancyGrid) -> NDArray[np.float32]:
    """(H, W) metres from each cell to the nearest wall cell, cut at 0.5 m so that stray cells do not steer."""
    field_px = cv2.distanceTransform((truth.cells != OCCUPIED).astype(np.uint8), cv2.DIST_L2, 5)
    return np.asarray(np.minimum(field_px * truth.resolution_m, 0.5), np.float32)


def cost(walls_m: NDArray[np.float64], T_world_global: SE2, truth: OccupancyGrid, distance_m: NDArray[np.float32]) -> float:
    rc = truth.cells_at(T_world_global.apply(walls_m))
    inside = ((rc >= 0) & (rc < (truth.height, truth.width))).all(axis=1)
    found = np.full(len(rc), 0.5, np.float32)
    found[inside] = distance_m[rc[inside, 0], rc[inside, 1]]
    return float(np.mean(np.square(found)))


def agreement(fused: OccupancyGrid, truth: OccupancyGrid, T_world_global: SE2) -> float:
    """Share of the map's known cells that are as in the world, a wall counting when it is within one cell of its place."""
    cells = np.argwhere(fused.cells != UNKNOWN)
    values = fused.cells[cells[:, 0], cells[:, 1]]
    kernel = np.ones((3, 3), np.uint8)
    near_wall = cv2.dilate((truth.cells == OCCUPIED).astype(np.uint8), kernel).astype(bool)
    near_free = cv2.dilate((truth.cells == FREE).astype(np.uint8), kernel).astype(bool)
    rc = truth.cells_at(T_world_global.apply(fused.points_of(cells)))
    inside = ((rc >= 0) & (rc < (truth.height, truth.width))).all(axis=1)
    right = np.zeros(len(cells), bool)
    rows, cols = rc[inside, 0], rc[inside, 1]
    right[inside] = np.where(values[inside] == OCCUPIED, near_wall[rows, cols], near_free[rows, cols])
    return float(right.mean()) if len(right) else 0.0
