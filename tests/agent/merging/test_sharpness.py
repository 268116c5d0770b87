"""The same room, and a room of the same size with other desks."""

from __future__ import annotations

import numpy as np
import pytest

from agent.merging.sharpness import Sharpness, sharpness
from agent.merging.views import witness
from tests.agent.merging.test_doubts import room

DESKS = [(row, col) for row in (25, 45, 65) for col in (25, 45, 65, 85, 105)]


def desks(shift: int) -> list[tuple[slice, slice]]:
    """Every second one a little to the right, and every other one a little to the left."""
    return [
        np.s_[row : row + 5, col + sign * shift : col + sign * shift + 12]
        for (row, col), sign in zip(DESKS, 8 * (1, -1), strict=False)
    ]


def said(shift: int, at_m: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Sharpness:
    return sharpness(witness(room(*desks(0))), witness(room(*desks(shift))), np.array(at_m))


def test_the_same_things_lie_as_sharply_as_the_walls() -> None:
    long_error_m, small_error_m = said(0)
    assert long_error_m < 0.02 and small_error_m < 0.02


def test_other_desks_lie_beside_each_other_where_the_walls_lie_on_each_other() -> None:
    long_error_m, small_error_m = said(2)
    assert long_error_m < 0.02 and small_error_m > 0.05


def test_what_is_laid_beside_its_place_errs_alike() -> None:
    long_error_m, small_error_m = said(0, (0.1, 0.1, 0.0))
    assert long_error_m == pytest.approx(0.1, abs=0.02) and small_error_m == pytest.approx(0.1, abs=0.02)


def test_where_nothing_agrees_the_usual_is_believed() -> None:
    assert said(0, (100.0, 0.0, 0.0)) == Sharpness(0.05, 0.05)
