"""Mailboxes between threads: newest wins, nothing grows, nobody waits for a reader."""

from __future__ import annotations

import threading

from agent.runtime.latest import KeyedLatest, Latest


def test_the_newest_value_replaces_the_unread_one() -> None:
    box: Latest[int] = Latest()
    for value in range(5):
        box.put(value)
    assert box.take() == 4
    assert box.take() is None
    assert box.replaced == 4


def test_take_wakes_when_another_thread_puts() -> None:
    box: Latest[str] = Latest()
    writer = threading.Timer(0.02, box.put, ("here",))
    writer.start()
    assert box.take(timeout_s=5.0) == "here"
    writer.join()


def test_each_key_keeps_its_turn_and_its_newest_value() -> None:
    box: KeyedLatest[int] = KeyedLatest(max_keys=8)
    box.put("a", 1)
    box.put("b", 2)
    box.put("a", 3)
    assert [box.take(), box.take(), box.take()] == [("a", 3), ("b", 2), None]
    assert box.replaced == 1


def test_a_flood_of_keys_costs_the_oldest_key_never_memory() -> None:
    box: KeyedLatest[int] = KeyedLatest(max_keys=16)
    for i in range(1000):
        box.put(f"k{i}", i)
    assert len(box) == 16
    assert box.dropped == 984
    assert box.take() == ("k984", 984)
