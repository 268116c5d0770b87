"""Arrays end to end behave like a list of them."""

from __future__ import annotations

import numpy as np
import pytest

from agent.mapping.packed_rows import PackedRows


def test_it_is_a_list_that_grows_at_its_end_and_shrinks_at_its_beginning() -> None:
    rng = np.random.default_rng(0)
    expected: list[np.ndarray] = []
    packed = PackedRows(np.empty((0, 3)))
    for k in range(300):
        rows = rng.normal(size=(int(rng.integers(1, 9)), 3))
        expected.append(rows)
        packed.append(rows)
        rows[:] = np.nan if k % 50 == 49 else rows
        if k % 37 == 36:
            packed.drop(20)
            del expected[:20]
        assert len(packed) == len(expected)
    kept = [e for e in expected if not np.isnan(e).any()]
    assert len(kept) < len(expected)  # what was handed in may change afterwards
    assert all(np.array_equal(p, e) for p, e in zip(packed, expected, strict=True) if not np.isnan(e).any())
    assert np.isfinite(np.vstack(list(packed))).all()
    assert np.array_equal(packed[-2], packed[len(packed) - 2])
    with pytest.raises(IndexError):
        packed[len(packed)]


def test_small_arrays_take_little_more_than_their_numbers() -> None:
    packed = PackedRows(np.empty((0, 3)), [np.zeros((8, 3))] * 1000)
    assert packed._rows.nbytes + packed._ends.itemsize * len(packed) < 1.3 * 1000 * 8 * 24
