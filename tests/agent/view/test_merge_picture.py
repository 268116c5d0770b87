"""The picture of a merge: colours tell who knows what, and no map is too odd to draw."""

from __future__ import annotations

import numpy as np
import pytest

from agent.view.merge_picture import (
    AGREE,
    AGREE_FREE,
    CONFLICT,
    OURS,
    OURS_FREE,
    THEIRS,
    THEIRS_FREE,
    MapToDraw,
    Overlay,
    merge_picture,
)
from agent.view.sheet import WIDTH
from protocol.features import FeatureMap
from protocol.geometry import SE2
from protocol.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

NONE_MATCHED = {"lines": [], "circles": [], "arcs": [], "curves": []}


def to_draw(cells: np.ndarray, features: FeatureMap | None = None) -> MapToDraw:
    return MapToDraw("a.yaml", OccupancyGrid(cells, 0.1), features or FeatureMap(), NONE_MATCHED)


def shows(picture: np.ndarray, colour: tuple[int, int, int]) -> int:
    return int((picture == colour).all(axis=2).sum())


def test_agreement_conflict_and_what_only_one_knows_have_their_colours():
    ours = np.full((40, 80), UNKNOWN, np.int8)
    theirs = ours.copy()
    ours[:, :50], theirs[:, 30:] = FREE, FREE
    ours[5, :50] = theirs[5, 30:] = OCCUPIED
    ours[20:24, 40] = OCCUPIED
    conflicts = np.zeros(ours.shape, np.bool_)
    conflicts[20:24, 40] = True
    overlay = Overlay(OccupancyGrid(ours, 0.1), ours, theirs, conflicts, SE2(0, 0, 0), SE2(1, 1, 1))
    legend_only = merge_picture(to_draw(ours), to_draw(theirs), None, "no", [])
    picture = merge_picture(to_draw(ours), to_draw(theirs), overlay, "merged", ["match factor 0.97"])
    for colour in (AGREE, AGREE_FREE, CONFLICT, OURS, OURS_FREE, THEIRS, THEIRS_FREE):
        assert shows(picture, colour) > shows(legend_only, colour) + 600
    assert picture.shape[1] == WIDTH


@pytest.mark.parametrize("shape", [(1, 1), (1, 5000), (3000, 2), (2500, 2500)])
def test_every_shape_of_map_can_be_drawn(shape):
    cells = np.full(shape, FREE, np.int8)
    features = FeatureMap(
        lines=np.array([[0, 0, 1, 5, 0.1, 0.1], [1e6, 0, 0, 1e6, 0, 0]], np.float32),
        circles=np.array([[0, 0, 1, 0.1]], np.float32),
        arcs=np.array([[0, 0, 1, 0, 2, 0.1]], np.float32),
        curves=np.array([[0, 0, 1, 2, 0.1]], np.float32),
    )
    drawn = MapToDraw("long.yaml", OccupancyGrid(cells, 0.05), features, {**NONE_MATCHED, "lines": [0, 1]})
    overlay = Overlay(drawn.grid, cells, cells, np.zeros(shape, np.bool_), SE2(0, 0, 0), SE2(1e5, 0, 1))
    assert merge_picture(drawn, drawn, overlay, "merged", []).shape[1] == WIDTH
