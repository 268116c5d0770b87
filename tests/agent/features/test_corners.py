"""Lines, corners and directions of one plan, whatever the frame it was mapped in."""

from __future__ import annotations

import math

import numpy as np
import pytest

from agent.features.snapshot import MapSnapshot
from agent.merging.rotations import rotation_candidates
from protocol.geometry import SE2
from tests.harness.floorplans import office

PLAN = office(seed=4)


def mapped(turn_rad: float) -> MapSnapshot:
    return MapSnapshot.of(PLAN.mapped(SE2(0.0, 0.0, turn_rad), noise_m=0.02, seed=1))


@pytest.mark.parametrize("turn_deg", [0, 20, 45, 133, 271])
def test_the_rotation_between_two_maps_is_among_the_first_candidates(turn_deg: int) -> None:
    rotations = rotation_candidates(mapped(math.radians(turn_deg)).directions, mapped(0.0).directions, 4)
    away = np.abs(np.remainder(rotations - math.radians(turn_deg) + math.pi, math.tau) - math.pi)
    assert math.degrees(away.min()) < 0.5


def test_normals_point_to_the_free_side() -> None:
    snapshot = mapped(0.3)
    ahead = snapshot.grid.origin.apply(snapshot.thin_walls.positions_m + 0.25 * snapshot.thin_walls.normals)
    behind = snapshot.grid.origin.apply(snapshot.thin_walls.positions_m - 0.25 * snapshot.thin_walls.normals)
    free_ahead = np.mean(snapshot.grid.values_at(ahead) == 0)
    assert free_ahead > 0.85
    assert free_ahead >= np.mean(snapshot.grid.values_at(behind) == 0)


def test_corners_of_a_rectangular_plan_are_square() -> None:
    corners = mapped(0.7).corners
    assert len(corners) > 10
    assert np.median(np.degrees(np.abs(corners.openings_rad - math.pi / 2))) < 1


def test_lines_are_longest_first_and_know_their_uncertainty() -> None:
    lines = mapped(0.1).lines
    assert (np.diff(lines.lengths_m) <= 0).all()
    assert (lines.sigma_theta_rad > 0).all()
    assert lines.sigma_theta_rad[0] < lines.sigma_theta_rad[-1]
