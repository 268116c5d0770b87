"""A small slice of the campaign: seeded days in which everything breaks, and the invariants that hold all the same."""

from __future__ import annotations

import pytest

from tests.fleet.schedules import run_schedule


@pytest.mark.parametrize("seed", [*range(24), 665])  # 665: where a robot began anew, its old place fits by chance
def test_the_invariants_hold_whatever_breaks(seed: int) -> None:
    outcome = run_schedule(seed)
    assert outcome.wrong_edges == 0
