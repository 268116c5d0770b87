"""A listener on a fleet: robots speak on one thread while pages look on others."""

from __future__ import annotations

import itertools
from dataclasses import replace

import pytest

from agent.runtime import watcher as module
from agent.runtime.network import NetworkSettings
from agent.runtime.watcher import Watcher
from protocol.messages import Stance, Statement
from tests.protocol.examples import evidence


def test_words_that_come_while_a_page_looks_disturb_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    watcher, numbers, plain = Watcher(NetworkSettings("w")), itertools.count(1), module.plain_statement

    def hear() -> None:
        seq = next(numbers)
        watcher._hear(Statement("r1", 1, seq, "r2", Stance.PROPOSE, replace(evidence(), agree=seq)))

    def drawn_while_another_speaks(statement: Statement) -> object:
        hear()
        return plain(statement)

    hear()
    monkeypatch.setattr(module, "plain_statement", drawn_while_another_speaks)
    assert len(watcher.status()["attempts"]) == 1
