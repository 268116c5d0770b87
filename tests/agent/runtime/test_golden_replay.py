"""A recorded run through whole agents: the decisions of the golden run, and the same ones to the bit each time.

`.venv/bin/python -m tests.bench.golden --make` keeps new decisions when they have changed on purpose.
"""

from __future__ import annotations

import pytest

from tests.harness import golden
from tests.harness.rehearsal import Heard, Rehearsal

Replayed = tuple[golden.Run, dict[str, Rehearsal], dict[str, Heard]]


@pytest.fixture(scope="module")
def replayed() -> Replayed:
    run = golden.read(golden.DEVICES)
    return run, *golden.replay_all(run)


def test_devices_and_network_played_again_give_the_same_decisions_to_the_bit(replayed: Replayed) -> None:
    run, robots, heard = replayed
    alone = golden.replay_alone(run, "robot-1", heard["robot-1"])
    assert golden.of_one(alone) == golden.of_one(robots["robot-1"])


def test_another_bit_heard_is_another_run(replayed: Replayed) -> None:
    run, robots, heard = replayed
    hints = [(now_s, key, payload[:-1] + b"?") for now_s, key, payload in heard["robot-1"].hints]
    short = golden.Run(run.urls, run.portions[: len(run.portions) // 4])
    alone = golden.replay_alone(short, "robot-1", Heard(hints))
    assert alone.node.fleet.garbage == len([hint for hint in hints if hint[0] < short.portions[-1].now_s])
    assert not alone.decisions()
    assert robots["robot-1"].decisions()


def test_the_decisions_are_those_of_the_golden_run(replayed: Replayed) -> None:
    _, robots, _ = replayed
    found = golden.differences(golden.kept(), golden.summary(robots.values()))
    assert not found, "\n".join([*found, "on purpose?  .venv/bin/python -m tests.bench.golden --make"])
