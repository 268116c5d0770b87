"""Whose doubts about a recipe count: those of robots that compared their maps with what it uses."""

from __future__ import annotations

import pytest

from agent.fleet.credibility import objection
from agent.fleet.ledger import pair_key
from agent.fleet.pair_words import PairWords
from tests.fleet.groups import fleet_of, names


@pytest.mark.parametrize(
    ("has_edge", "has_taken_back", "counts"), [(True, False, True), (False, True, True), (False, False, False)]
)
def test_held_back_cells_count_for_those_who_compared_them(has_edge: bool, has_taken_back: bool, counts: bool) -> None:
    fleet = fleet_of(3)
    fleet.run_until(lambda: fleet.agrees(names(3)), 20.0)
    coordinator = fleet.nodes["r2"].coordinator
    assert coordinator is not None
    ledger = coordinator._ledger
    group, meta, doubted = ledger.group, ledger.peers["r0"].meta, ledger.peers["r1"]
    assert group is not None and meta is not None and doubted.held is not None
    assert objection(ledger, meta, group) == ""
    doubted.refused.append(doubted.held.digest)
    if has_taken_back:
        PairWords(ledger).withdraw("r1", "map turned false", fleet.now_s)
    elif not has_edge:
        ledger.mine.pop("r1", None)
    if not has_edge:
        ledger.live.pop(pair_key("r1", "r2"), None)
    assert bool(objection(ledger, meta, group)) == counts
