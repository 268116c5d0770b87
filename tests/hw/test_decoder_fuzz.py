"""Hostile bytes, a little of them; `tests/campaigns/decoder_fuzz.py` feeds millions."""

from __future__ import annotations

from tests.campaigns.decoder_fuzz import fuzz


def test_no_decoder_raises_grows_or_goes_deaf() -> None:
    result = fuzz(inputs=16 * 256, seed=9)
    assert result.failures == 0, result.first_failure
    assert result.scans > 0
