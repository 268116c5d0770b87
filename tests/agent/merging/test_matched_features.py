"""Matched features: what coincides, faces the same way, and is of a size."""

from __future__ import annotations

import numpy as np

from agent.merging.matched_features import matched_features
from protocol.features import FeatureMap
from protocol.geometry import SE2


def lines(*rows: tuple[float, float, float, float]) -> FeatureMap:
    return FeatureMap(lines=np.array([(*row, 0.01, 0.01) for row in rows], np.float32).reshape(-1, 6))


HERE = SE2.identity()


def test_a_line_matches_a_shifted_part_of_itself():
    pairs = matched_features(lines((0, 0, 1.57, 4.0)), lines((1.5, 0.05, 1.57, 2.0)), HERE)
    assert pairs.lines.tolist() == [[0, 0]]


def test_the_two_sides_of_a_wall_do_not_match():
    assert len(matched_features(lines((0, 0, 1.57, 4.0)), lines((0, 0, -1.57, 4.0)), HERE)) == 0


def test_lines_in_a_row_do_not_match():
    assert len(matched_features(lines((0, 0, 1.57, 2.0)), lines((2.5, 0, 1.57, 2.0)), HERE)) == 0


def test_every_line_is_used_once_and_the_closest_wins():
    pairs = matched_features(lines((0, 0, 1.57, 4.0)), lines((0, 0.25, 1.57, 4.0), (0, 0.02, 1.57, 4.0)), HERE)
    assert pairs.lines.tolist() == [[0, 1]]


def test_their_features_are_moved_first():
    T = SE2(5.0, 2.0, 0.8)
    theirs = lines((0, 0, 1.0, 3.0))
    middle = T.apply([(0.0, 0.0)])[0]
    assert matched_features(lines((*middle, 1.8, 3.0)), theirs, T).lines.tolist() == [[0, 0]]


def test_circles_match_by_centre_and_radius():
    ours = FeatureMap(circles=np.array([(0, 0, 0.5, 0.01), (4, 0, 0.5, 0.01)], np.float32))
    theirs = FeatureMap(circles=np.array([(4.1, 0, 0.52, 0.01), (0, 0.1, 2.0, 0.01)], np.float32))
    assert matched_features(ours, theirs, HERE).circles.tolist() == [[1, 0]]
