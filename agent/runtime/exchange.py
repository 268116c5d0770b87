"""The one door to Zenoh: small hints are pushed and may be lost, registers are pulled when the receiver wants them.

            put (DROP, <= 32 KB)                              get key (two in flight)
   hint ─────────────────────────► inbox of the peers    peer ────────────────────────► one queryable ──► answer(key)
                                                              ◄──────────────────────── at most 32 KB

Three rules keep one bad peer from freezing the rest (ZENOH.md, section 0): nothing is ever sent with BLOCK; a callback does
nothing but one bounded enqueue, on Zenoh's own thread; the session is closed in a `finally`, whatever happened.
"""

from __future__ import annotations

import json
import logging
import re
import threading
import time
from collections.abc import Sequence
from typing import Any

import zenoh

from agent.runtime.answering import Answer, Answering
from agent.runtime.latest import KeyedLatest
from agent.runtime.network import NetworkSettings, zenoh_config
from agent.runtime.pending import Pending
from agent.runtime.traffic import MAX_PAYLOAD_BYTES, Traffic

log = logging.getLogger(__name__)

QUERY_TIMEOUT_S = 5.0
ASK_AGAIN_S = 1.5  # a question that went into a link just before it came back stays unanswered
SLOW_FACTOR = 3.0  # over a slow radio the second question waits for this many times the time the last answer took


class Exchange:
    """One Zenoh session.  Use with `with`; `inbox` holds the newest message of every key that somebody pushed."""

    def __init__(
        self, settings: NetworkSettings, answer: Answer, subscribe: Sequence[str] = (), serve: str | None = None
    ) -> None:
        self.settings = settings.checked()
        self.inbox: KeyedLatest[bytes] = KeyedLatest(max_keys=1024)
        self.traffic = Traffic()
        self.closed = threading.Event()
        self._subscribe, self._serve = tuple(subscribe), serve
        self._session: Any = None
        self._answer_took_s = 0.0  # the last one: a slow link is not asked twice
        self._swap = threading.Lock()  # opening and closing only
        self._answering = Answering(answer, self.traffic, self.closed, zenoh.ZError)

    def __enter__(self) -> Exchange:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def open(self) -> None:
        """Open the session; `ZError` from Zenoh becomes one `ExchangeError` that says what to try.

        A client whose router is away maps on its own until `reopen` finds it: see `is_open`.
        """
        try:
            self._open_session(self.settings.connect)
        except ExchangeError as error:
            if self.settings.mode != "client":
                raise
            log.warning("%s Trying again until it does.", error)
        self._answering.start()

    @property
    def is_open(self) -> bool:
        return self._session is not None

    def stop_waiting(self) -> None:
        """Whoever waits for an answer or a message goes on without one; nothing new is asked."""
        self.closed.set()
        self.inbox.wake()

    def close(self) -> None:
        """Leave the network.  Never raises, never waits more than Zenoh's own 10 s."""
        self.stop_waiting()
        with self._swap:
            self._close_session()
        self._answering.join()

    def reopen(self, connect: tuple[str, ...]) -> None:
        """Start a new session with these endpoints: links learnt by gossip are never dialled again by Zenoh itself."""
        with self._swap:
            if self.closed.is_set():
                return
            self._close_session()
            try:
                self._open_session(connect)
            except ExchangeError as error:
                log.debug("%s", error)

    def _open_session(self, connect: tuple[str, ...]) -> None:
        config = zenoh_config(self.settings)
        config["connect"]["endpoints"] = list(connect)
        try:
            session: Any = zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
        except zenoh.ZError as error:
            listen = ", ".join(self.settings.endpoints()) or "nothing"
            raise ExchangeError(
                f"network: cannot open (listen {listen}, connect {', '.join(connect) or 'nothing'}): {plain(error)}. "
                "Is the port free, and does the router answer?"
            ) from error
        try:
            on_sample = zenoh.handlers.Callback(self._on_sample, indirect=False)  # no thread, so no hang at exit
            for key in self._subscribe:
                session.declare_subscriber(key, on_sample, allowed_origin=zenoh.Locality.REMOTE)  # not our own echo
            if self._serve is not None:
                session.declare_queryable(self._serve, zenoh.handlers.Callback(self._answering.on_query, indirect=False))
        except BaseException:
            session.close()
            raise
        self._session = session

    def _close_session(self) -> None:
        session, self._session = self._session, None
        close(session)

    # Hearing.

    def _on_sample(self, sample: Any) -> None:
        """On Zenoh's thread: one bounded enqueue."""
        payload = sample.payload.to_bytes()
        self.traffic.received_messages += 1
        self.traffic.received_bytes += len(payload)
        if len(payload) > MAX_PAYLOAD_BYTES:
            self.traffic.refused += 1
            return
        self.inbox.put(str(sample.key_expr), payload)

    # Pushing.

    def put(self, key: str, payload: bytes, priority: str = "DATA", *, is_express: bool = False) -> bool:
        """Push a hint, best effort.  False when it could not even be tried (closed, too large)."""
        session = self._session
        if session is None or len(payload) > MAX_PAYLOAD_BYTES:
            self.traffic.refused += 1
            return False
        try:
            session.put(
                key,
                payload,
                congestion_control=zenoh.CongestionControl.DROP,  # BLOCK stalls healthy pairs for 5 to 10 s when one robot dies
                priority=getattr(zenoh.Priority, priority),
                express=is_express,
            )
        except zenoh.ZError as error:
            log.debug("put %s: %s", key, error)
            return False
        self.traffic.sent_bytes += len(payload)
        return True

    # Asking.

    def ask(self, key: str, priority: str = "DATA") -> Pending | None:
        """Query one register; None when the session is closed.  Never waits: `receive` does."""
        pending = Pending(lambda pending: self._get(key, priority, pending))
        return pending if self._get(key, priority, pending) else None

    def _get(self, key: str, priority: str, pending: Pending) -> bool:
        session = self._session
        if session is None:
            return False
        try:
            session.get(
                key,
                zenoh.handlers.Callback(pending.on_reply, pending.on_end, indirect=False),
                consolidation=zenoh.ConsolidationMode.NONE,  # one queryable answers once: nothing to consolidate, no wait for it
                congestion_control=zenoh.CongestionControl.DROP,
                priority=getattr(zenoh.Priority, priority),
                timeout=QUERY_TIMEOUT_S,
            )
        except zenoh.ZError as error:
            log.debug("ask %s: %s", key, error)
            return False
        return True

    def receive(self, pending: Pending | None) -> bytes | None:
        """Wait for an answer; None when none came.  NoSuchRegister: who was asked has none."""
        started_s, again_s = time.monotonic(), max(ASK_AGAIN_S, SLOW_FACTOR * self._answer_took_s)
        content = None if pending is None else pending.wait(QUERY_TIMEOUT_S + 1.0, again_s, self.closed)
        if content is None:
            self.traffic.unanswered += 1
            return None
        self._answer_took_s = time.monotonic() - started_s
        self.traffic.pulled_bytes += len(content)
        return content

    # What a person, or a test harness, wants to know.

    def locators(self) -> list[str]:
        """Where others can dial us: with port 0, the port that the system chose."""
        session = self._session
        if session is None:
            return []
        try:
            description = self.receive(self.ask(f"@/{session.zid()}/{self.settings.mode}"))
            return [str(locator) for locator in json.loads(description or b"{}").get("locators", [])]
        except (ValueError, zenoh.ZError):
            return []

    def links(self) -> list[str]:
        """The remote ends we are linked to."""
        session = self._session
        if session is None:
            return []
        try:
            return sorted(str(link.dst) for link in session.info.links())
        except zenoh.ZError:
            return []


class ExchangeError(Exception):
    """The network could not be opened: the program says so and stops, because a dead mesh looks healthy from inside."""


def plain(error: Exception) -> str:
    """What Zenoh says, without where in its source it said so."""
    return re.sub(r" at /\S+\.rs:\d+\.?", "", str(error)).rstrip(". ")


def close(session: Any) -> None:
    """Close a Zenoh session, if there is one.  Never raises."""
    if session is not None:
        try:
            session.close()
        except zenoh.ZError as error:
            log.warning("network: the session did not close cleanly: %s", error)
