"""Zenoh's traps, each with the claim that we do not fall into it (ZENOH.md, section 0)."""

from __future__ import annotations

import re
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from agent.runtime import announcer as announcer_module
from agent.runtime import exchange as exchange_module
from agent.runtime.exchange import Exchange, ExchangeError
from agent.runtime.network import NetworkSettings
from agent.runtime.pending import NoSuchRegister
from agent.runtime.traffic import MAX_PAYLOAD_BYTES
from tests.harness.waiting import until

ROOT = Path(__file__).resolve().parents[3]


def nothing(_: str) -> bytes | None:
    return None


@pytest.fixture
def hub() -> Iterator[Exchange]:
    """The peer that others dial; answers every key below t/hub with the key itself."""
    with Exchange(NetworkSettings("hub"), lambda key: key.encode(), subscribe=("t/*/beat",), serve="t/hub/**") as exchange:
        yield exchange


def dial(hub: Exchange, robot: str = "leaf", subscribe: tuple[str, ...] = ()) -> Exchange:
    return Exchange(NetworkSettings(robot, connect=tuple(hub.locators())), nothing, subscribe=subscribe)


def answer(asker: Exchange, key: str) -> bytes | None:
    try:
        return asker.receive(asker.ask(key))
    except NoSuchRegister:
        return None


def test_an_ephemeral_port_is_known_and_dialled(hub: Exchange) -> None:
    (locator,) = hub.locators()
    assert re.fullmatch(r"tcp/127\.0\.0\.1:\d+", locator)
    with dial(hub) as leaf:
        until(lambda: leaf.links() == [locator])


def test_a_register_is_answered(hub: Exchange) -> None:
    with dial(hub) as leaf:
        until(leaf.links)
        assert leaf.receive(leaf.ask("t/hub/map/coarse")) == b"t/hub/map/coarse"


def test_nobody_there_is_none_and_not_an_error(hub: Exchange) -> None:
    with dial(hub) as leaf:
        until(leaf.links)
        assert leaf.receive(leaf.ask("t/nobody/map")) is None
        assert leaf.traffic.unanswered == 1


def test_a_question_that_stays_silent_is_asked_once_more() -> None:
    """The hub is deaf to the first question, as if its link had been dead just then."""
    heard: list[str] = []

    def answer(key: str) -> bytes | None:
        heard.append(key)
        if len(heard) == 1:
            raise RuntimeError("deaf")
        return key.encode()

    with Exchange(NetworkSettings("deaf"), answer, serve="t/deaf/**") as deaf, dial(deaf) as leaf:
        until(leaf.links)
        pending = leaf.ask("t/deaf/x")
        assert pending is not None
        assert pending.wait(5.0, 0.0, threading.Event()) == b"t/deaf/x"
    assert heard == ["t/deaf/x", "t/deaf/x"]


def test_only_the_newest_unread_message_of_a_key_waits(hub: Exchange) -> None:
    with dial(hub) as leaf:
        until(lambda: leaf.put("t/leaf/beat", b"first") and len(hub.inbox))
        for number in range(200):
            leaf.put("t/leaf/beat", str(number).encode())
        until(lambda: hub.traffic.received_messages >= 200)
        assert len(hub.inbox) == 1


def test_a_reader_that_never_reads_does_not_freeze_its_peer(hub: Exchange) -> None:
    """Fact 2: with Zenoh's default handler the unread messages below stop every answer from that session."""
    with dial(hub) as leaf:
        until(leaf.links)
        for number in range(2000):
            leaf.put(f"t/k{number % 500}/beat", bytes(4000))
        until(lambda: leaf.receive(leaf.ask("t/hub/x")) == b"t/hub/x", 20.0)  # a burst may drop the query itself
        assert len(hub.inbox) <= 1024


def test_our_own_words_do_not_come_back_to_us(hub: Exchange) -> None:
    with dial(hub, subscribe=("t/*/beat",)) as leaf:
        until(lambda: hub.put("t/hub/beat", b"x") and len(leaf.inbox))
        assert len(hub.inbox) == 0


def test_too_large_a_hint_is_refused_at_once(hub: Exchange) -> None:
    assert not hub.put("t/hub/beat", bytes(MAX_PAYLOAD_BYTES + 1))
    assert hub.traffic.refused == 1


def test_too_large_an_answer_is_not_sent() -> None:
    with (
        Exchange(NetworkSettings("hub"), lambda _: bytes(MAX_PAYLOAD_BYTES + 1), serve="t/hub/**") as hub,
        dial(hub) as leaf,
    ):
        until(leaf.links)
        with pytest.raises(NoSuchRegister):
            leaf.receive(leaf.ask("t/hub/x"))


def test_a_register_that_is_not_there_is_told_from_an_answer_that_is_lost() -> None:
    with Exchange(NetworkSettings("hub"), nothing, serve="t/hub/**") as hub, dial(hub) as leaf:
        until(leaf.links)
        started = time.monotonic()
        with pytest.raises(NoSuchRegister):
            leaf.receive(leaf.ask("t/hub/map/gone"))
        assert time.monotonic() - started < 3.0 and leaf.traffic.unanswered == 0


def test_what_one_denies_another_may_have() -> None:
    """Two lives of one robot serve the same registers for a while."""
    with (
        Exchange(NetworkSettings("hub"), nothing, serve="t/hub/**") as hub,
        Exchange(NetworkSettings("twin"), lambda key: b"here", serve="t/hub/**") as twin,
        Exchange(NetworkSettings("leaf", connect=(*hub.locators(), *twin.locators())), nothing) as leaf,
    ):
        until(lambda: len(leaf.links()) == 2)
        until(lambda: answer(leaf, "t/hub/x") == b"here")
        assert [answer(leaf, "t/hub/x") for _ in range(20)] == [b"here"] * 20


def test_a_bug_in_answering_costs_one_answer() -> None:
    def answer(key: str) -> bytes | None:
        if key.endswith("bad"):
            raise RuntimeError("bug")
        return b"fine"

    with Exchange(NetworkSettings("hub"), answer, serve="t/hub/**") as hub, dial(hub) as leaf:
        until(leaf.links)
        assert leaf.receive(leaf.ask("t/hub/bad")) is None
        assert leaf.receive(leaf.ask("t/hub/good")) == b"fine"


def test_the_same_port_twice_is_one_clear_sentence(hub: Exchange) -> None:
    (locator,) = hub.locators()
    with pytest.raises(ExchangeError, match="Is the port free") as refused:
        Exchange(NetworkSettings("other", listen=(locator,)), nothing).open()
    assert "Address already in use" in str(refused.value) and ".rs:" not in str(refused.value), "where, not in whose source"


def test_a_dead_seed_does_not_keep_a_robot_from_starting(hub: Exchange) -> None:
    seeds = ("tcp/127.0.0.1:9", *hub.locators())
    with Exchange(NetworkSettings("leaf", connect=seeds), nothing) as leaf:
        until(leaf.links)


def test_a_reopened_session_hears_and_answers_again(hub: Exchange) -> None:
    with dial(hub, subscribe=("t/*/beat",)) as leaf:
        until(leaf.links)
        leaf.reopen(tuple(hub.locators()))
        until(lambda: hub.put("t/hub/beat", b"again") and len(leaf.inbox))


def test_closing_while_a_query_waits_is_prompt(hub: Exchange) -> None:
    slow = threading.Event()
    with Exchange(NetworkSettings("slow"), lambda _: slow.wait(20) and b"", serve="t/slow/**") as silent:
        leaf = dial(silent)
        leaf.open()
        until(leaf.links)
        answers: list[bytes | None] = []
        waiting = threading.Thread(target=lambda: answers.append(leaf.receive(leaf.ask("t/slow/x"))))
        waiting.start()
        started = time.monotonic()
        leaf.close()
        waiting.join(5.0)
        assert answers == [None]
        assert time.monotonic() - started < 3.0
        slow.set()


def test_nothing_is_ever_sent_with_block() -> None:
    source = "".join(Path(str(module.__file__)).read_text() for module in (exchange_module, announcer_module))
    assert "CongestionControl.BLOCK" not in source
    sends = len(re.findall(r"session\.(?:put|get)\(\n?\s*key|declare_\w*publisher\(", source))
    assert source.count("CongestionControl.DROP") == sends == 3


ENDINGS = (
    "pass",
    "raise SystemExit(0)",
    "exchange.put('t/x/beat', b'1')",
    "exchange.ask('t/none/x')",
    "exchange.reopen(())",
    "exchange.close()",
)


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_process_ends_in_every_state(ending: str) -> None:
    """Fact 1: a session with a Python callback that is left open hangs its process at exit."""
    script = f"""
        import sys
        sys.path.insert(0, {str(ROOT)!r})
        from agent.runtime.exchange import Exchange
        from agent.runtime.network import NetworkSettings
        with Exchange(NetworkSettings("x"), lambda key: None, subscribe=("t/*/beat",), serve="t/x/**") as exchange:
            {ending}
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(script)], timeout=20, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode()
