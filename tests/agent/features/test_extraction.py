"""The complete feature map: each thing is one feature, in metres of the map frame, and noise makes it vaguer, not other."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings

from agent.features.extraction import extract_features
from protocol.geometry import SE2, wrap_angle, wrap_angles
from protocol.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from tests.agent.features.test_paper import any_cells
from tests.harness.floorplans import FloorPlan, office


def hall(origin: SE2 = SE2(0.0, 0.0, 0.0)) -> OccupancyGrid:
    """23 m x 18 m at 5 cm: two pillars, a half-round bay of 3 m radius, a bow of 4 m radius, and a folding screen."""
    cells = np.full((400, 500), UNKNOWN, np.int8)
    cells[20:380, 20:480] = FREE
    cv2.rectangle(cells, (20, 20), (480, 380), OCCUPIED, 1)
    cv2.circle(cells.view(np.uint8), (100, 100), 6, 255, -1)
    for centre, radius in (((100, 100), 6), ((200, 100), 20)):
        cv2.circle(cells, centre, radius, OCCUPIED, 1)
    cv2.ellipse(cells, (350, 380), (60, 60), 0, 180, 360, OCCUPIED, 1)
    cells[381:] = UNKNOWN
    cv2.ellipse(cells, (60, 300), (80, 80), 0, -60, 60, OCCUPIED, 1)
    screen = [(250 + 5 * (-1) ** i, 200 + 9 * i) for i in range(14)]
    cv2.polylines(cells, [np.rint(screen).astype(np.int32)], False, OCCUPIED, 1)
    return OccupancyGrid(cells, 0.05, origin)


def test_circles_have_their_centre_and_radius_within_their_sigma():
    circles = extract_features(hall()).circles
    assert len(circles) == 2
    for circle, truth in zip(circles, [(10.025, 5.025, 1.0), (5.025, 5.025, 0.3)], strict=True):
        assert np.abs(circle[:3] - truth).max() < max(0.05, 3 * circle[3])


def test_arcs_have_centre_radius_start_and_span():
    arcs = extract_features(hall()).arcs
    bay = arcs[np.hypot(arcs[:, 0] - 17.525, arcs[:, 1] - 19.025) < 0.1][0]
    assert bay[2] == pytest.approx(3.0, abs=0.05)
    assert abs(wrap_angle(float(bay[3]) - math.pi)) < 0.1
    assert bay[4] == pytest.approx(math.pi, abs=0.25)  # its ends belong to the wall they meet
    bow = arcs[np.hypot(arcs[:, 0] - 3.025, arcs[:, 1] - 15.025) < 0.15][0]
    assert bow[2] == pytest.approx(4.0, abs=0.1)
    assert bow[4] == pytest.approx(math.radians(120), abs=0.15)


def test_what_an_arc_explains_is_no_line_as_well():
    lines = extract_features(hall()).lines
    from_bay = np.hypot(lines[:, 0] - 17.525, lines[:, 1] - 19.025)
    assert not (np.abs(from_bay - 3.0) < 0.15).any()
    assert (lines[:4, 3] > 17).all()


@pytest.mark.parametrize("seed", [3, 9])
def test_no_wall_is_two_lines_however_noisy(seed: int):
    lines = extract_features(office(seed).mapped(SE2(1.0, 2.0, 0.4), noise_m=0.05, seed=1)).lines
    for x, y, angle, length, *_ in lines:
        away = lines[:, :2] - (x, y)
        beside = away @ (math.cos(angle), math.sin(angle))
        ahead = away @ (-math.sin(angle), math.cos(angle))
        alike = np.abs(wrap_angles(lines[:, 2] - angle)) < math.radians(4)
        same_wall = alike & (np.abs(beside) < 0.08) & (np.abs(ahead) < 0.5 * length) & (lines[:, 3] < length)
        assert not same_wall.any()


def test_what_is_neither_straight_nor_round_is_a_curve():
    curves = extract_features(hall()).curves
    on_screen = (np.abs(curves[:, 0] - 12.5) < 1.0) & (curves[:, 1] > 9.5) & (curves[:, 1] < 16)
    assert on_screen.sum() >= 1
    assert (curves[:, 4] > 0).all()


def test_the_map_frame_moves_every_feature_along():
    T = SE2(-4.0, 7.0, 2.0)
    here, there = extract_features(hall()), extract_features(hall(T))
    for kind in ("lines", "circles", "arcs", "curves"):
        assert getattr(there, kind)[:, :2] == pytest.approx(T.apply(getattr(here, kind)[:, :2]), abs=1e-4)
    for turned in (
        there.lines[:, 2] - here.lines[:, 2],
        there.arcs[:, 3] - here.arcs[:, 3],
        there.curves[:, 2] - here.curves[:, 2],
    ):
        assert np.abs(wrap_angles(turned - T.theta_rad)).max() < 1e-4


def seen_again(ours: np.ndarray, theirs: np.ndarray, T: SE2, within_m: float) -> float:
    """Share of their features that ours has at the same place."""
    away = T.apply(theirs[:, :2])[:, None, :] - ours[None, :, :2]
    return float((np.hypot(away[..., 0], away[..., 1]).min(axis=1) < within_m).mean())


def test_another_robot_sees_the_same_circles_and_curves():
    plan, T_b = office(4), SE2(2.0, -9.0, 1.1)
    ours, theirs = plan.mapped(SE2(0, 0, 0), 0.05), plan.mapped(T_b, 0.05, (8.0, 22.0))
    a, b = extract_features(ours), extract_features(theirs)
    assert seen_again(a.circles, b.circles, T_b.inverse(), 0.1) >= 0.8
    assert seen_again(a.curves, b.curves, T_b.inverse(), 0.35) >= 0.7


def test_noise_makes_features_vaguer_and_not_other():
    plan = office(4)
    clean = extract_features(plan.mapped(SE2(0, 0, 0.3), 0.05))
    noisy = extract_features(plan.mapped(SE2(0, 0, 0.3), 0.05, noise_m=0.05))
    here = SE2.identity()
    assert seen_again(noisy.circles, clean.circles, here, 0.12) >= 0.8
    assert np.median(noisy.circles[:, 3]) > np.median(clean.circles[:, 3])
    long = clean.lines[clean.lines[:, 3] > 3]
    angles = np.abs(wrap_angles(long[:, None, 2] - noisy.lines[None, :, 2]))
    across = np.abs(((long[:, None, :2] - noisy.lines[None, :, :2]) * _normals(long)[:, None]).sum(axis=2))
    assert ((angles < 0.02) & (across < 0.06)).any(axis=1).mean() >= 0.9


def _normals(lines: np.ndarray) -> np.ndarray:
    return np.stack([np.cos(lines[:, 2]), np.sin(lines[:, 2])], axis=1)


def test_straight_walls_are_never_round():
    walls = np.array([(0, 0, 20, 0), (20, 0, 20, 9), (20, 9, 0, 9), (0, 9, 0, 0), (5, 2, 12, 6), (3, 8, 3.8, 8)], np.float64)
    plan = FloorPlan(walls, np.zeros((0, 3)), 20.0, 9.0)
    for yaw in (0.0, 0.3, 0.7, 1.2):
        features = extract_features(plan.mapped(SE2(0, 0, yaw), 0.05))
        assert len(features.circles) == len(features.arcs) == 0


@settings(max_examples=60, deadline=None)
@given(any_cells)
def test_no_cells_whatever_upset_it(cells):
    features = extract_features(OccupancyGrid(cells, 0.1))
    for kind in (features.lines, features.circles, features.arcs, features.curves):
        assert np.isfinite(kind).all()
        assert kind.dtype == np.float32


@pytest.mark.parametrize("side", [150, 500])
def test_hostile_patterns_are_bounded(side):
    rng = np.random.default_rng(0)
    checkerboard = np.where(np.indices((side, side)).sum(axis=0) % 2, OCCUPIED, FREE).astype(np.int8)
    dust = np.where(rng.random((side, side)) < 0.2, OCCUPIED, FREE).astype(np.int8)
    for cells in (checkerboard, dust):
        features = extract_features(OccupancyGrid(cells, 0.1))
        assert len(features.circles) + len(features.arcs) <= 64
        assert len(features.curves) <= 48
