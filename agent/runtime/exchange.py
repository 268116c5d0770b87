"""The one door to Zenoh: small hints are pushed and may be lost, bulk is pulled in chunks at the receiver's pace.

                 put (DROP, <= 16 KB)                      pull: get key?i=0, i=1, ... two in flight
   our words ─────────────────────────► inbox of a peer    peer ──────────────► one queryable ──► answer(key, request)
                                                                ◄────────────── 16 KB + (chunks, bytes, sha256)

Three rules keep one bad peer from freezing the rest (ZENOH.md, section 0): nothing is ever sent with BLOCK; a callback does
nothing but one bounded enqueue, on Zenoh's own thread; the session is closed in a `finally`, whatever happened.
"""

from __future__ import annotations

import hashlib
import json
import logging
import queue
import struct
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import zenoh

from agent.runtime.latest import KeyedLatest
from agent.runtime.network import NetworkSettings, zenoh_config

log = logging.getLogger(__name__)

MAX_HINT_BYTES = 16 * 1024  # a single 200 KB put is silently lost on 20 Mbit/s; this fits one batch
CHUNK_BYTES = 16 * 1024  # 64 KB must drain within 5 s or the transport closes: 16 KB still does at 64 kbit/s
CHUNKS_IN_FLIGHT = 2  # the same throughput as one big reply, with the beat waiting 0.2 s instead of 1.0 s at 1 Mbit/s
CHUNK_TIMEOUT_S = 5.0
MAX_RETRIES = 6  # of one pull, over all its chunks
MAX_PULL_BYTES = 16 * 1024 * 1024
CHUNK_HEADER = struct.Struct("<2sHI32s")  # magic, number of chunks, bytes in all, sha256 of the whole
CHUNK_MAGIC = b"mq"
MAX_QUERIES_WAITING = 256
MAX_ANSWERS_KEPT = 16
ANSWER_KEPT_S = 20.0  # the chunks of one pull come from one answer, even when the map moves on meanwhile

Answer = Callable[[str, bytes], "bytes | None"]  # (key, request) -> the whole content; runs on the answering thread
Guard = Callable[[bytes], "bytes | None"]  # a payload as it travels -> as it reads, or the other way; None: refused


@dataclass(slots=True)
class Traffic:
    """What passed through the door since the start."""

    sent_messages: int = 0
    sent_bytes: int = 0
    received_messages: int = 0
    received_bytes: int = 0
    pulled_bytes: int = 0
    served_bytes: int = 0
    refused: int = 0  # too large, or the guard said no
    failed_pulls: int = 0
    dropped_queries: int = 0


@dataclass(slots=True)
class _Replies:
    """What one `get` brings: a queue filled on Zenoh's thread; None marks the end."""

    arrived: queue.SimpleQueue[Any] = field(default_factory=queue.SimpleQueue)
    count: int = 0

    def on_reply(self, reply: Any) -> None:
        self.count += 1
        if self.count <= 4:  # one is expected; a liar may send many
            self.arrived.put(reply)

    def on_end(self) -> None:
        self.arrived.put(None)


class Exchange:
    """One Zenoh session.  Use with `with`; `inbox` holds the newest message of every key that somebody pushed."""

    def __init__(
        self,
        settings: NetworkSettings,
        answer: Answer,
        subscribe: tuple[str, ...] = (),
        serve: str | None = None,
        seal: Guard | None = None,
        unseal: Guard | None = None,
    ) -> None:
        self.settings = settings.checked()
        self.inbox: KeyedLatest[bytes] = KeyedLatest(max_keys=1024)
        self.traffic = Traffic()
        self._answer, self._seal, self._unseal = answer, seal, unseal
        self._subscribe, self._serve = subscribe, serve
        self._queries: queue.Queue[Any] = queue.Queue(maxsize=MAX_QUERIES_WAITING)
        self._answers: OrderedDict[tuple[str, bytes], tuple[float, bytes, bytes]] = OrderedDict()
        self._session: Any = None
        self._token: Any = None
        self._swap = threading.Lock()  # opening and closing only
        self._closed = threading.Event()
        self._answering = threading.Thread(target=self._answer_queries, name="answers", daemon=True)

    def __enter__(self) -> Exchange:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def open(self) -> None:
        """Open the session; `ZError` from Zenoh becomes one `ExchangeError` that says what to try."""
        self._open_session(self.settings.connect)
        self._answering.start()

    def close(self) -> None:
        """Leave the network.  Never raises, never waits more than Zenoh's own 10 s."""
        self._closed.set()
        self.inbox.wake()
        with self._swap:
            self._close_session()
        if self._answering.is_alive():
            self._answering.join(2.0)

    def reopen(self, connect: tuple[str, ...]) -> None:
        """Start a new session with these endpoints: links learnt by gossip are never dialled again by Zenoh itself."""
        with self._swap:
            if self._closed.is_set():
                return
            self._close_session()
            try:
                self._open_session(connect)
            except ExchangeError:
                log.warning("network: could not open again, next try later", exc_info=True)

    def _open_session(self, connect: tuple[str, ...]) -> None:
        config = zenoh_config(self.settings)
        config["connect"]["endpoints"] = list(connect)
        try:
            session: Any = zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
        except zenoh.ZError as error:
            listen = ", ".join(self.settings.endpoints()) or "nothing"
            raise ExchangeError(
                f"network: cannot open (listen {listen}, connect {', '.join(connect) or 'nothing'}): {error}. "
                "Is the port free, and does the router answer?"
            ) from error
        try:
            on_sample = zenoh.handlers.Callback(self._on_sample, indirect=False)  # no thread, so no hang at exit
            for key in self._subscribe:
                session.declare_subscriber(key, on_sample)
            if self._serve is not None:
                session.declare_queryable(self._serve, zenoh.handlers.Callback(self._on_query, indirect=False))
        except BaseException:
            session.close()
            raise
        self._session = session

    def _close_session(self) -> None:
        session, self._session, self._token = self._session, None, None
        if session is not None:
            try:
                session.close()
            except zenoh.ZError as error:
                log.warning("network: the session did not close cleanly: %s", error)

    # Callbacks: on Zenoh's thread, one bounded enqueue each.

    def _on_sample(self, sample: Any) -> None:
        payload = sample.payload.to_bytes()
        self.traffic.received_messages += 1
        self.traffic.received_bytes += len(payload)
        if len(payload) > 2 * MAX_HINT_BYTES:
            self.traffic.refused += 1
            return
        self.inbox.put(str(sample.key_expr), payload)

    def _on_query(self, query: Any) -> None:
        try:
            self._queries.put_nowait(query)
        except queue.Full:
            self.traffic.dropped_queries += 1
            query.drop()  # a query that is kept makes the other side wait for its timeout

    # Pushing.

    def put(self, key: str, payload: bytes, *, urgent: bool = False) -> bool:
        """Push a hint, best effort.  False when it could not even be tried (closed, refused, too large)."""
        sealed = payload if self._seal is None else self._seal(payload)
        session = self._session
        if sealed is None or session is None or len(sealed) > 2 * MAX_HINT_BYTES:
            self.traffic.refused += 1
            return False
        try:
            session.put(
                key,
                sealed,
                congestion_control=zenoh.CongestionControl.DROP,  # BLOCK stalls healthy pairs for 5 to 10 s when one robot dies
                priority=zenoh.Priority.INTERACTIVE_HIGH if urgent else zenoh.Priority.DATA,
                express=urgent,
            )
        except zenoh.ZError as error:
            log.debug("put %s: %s", key, error)
            return False
        self.traffic.sent_messages += 1
        self.traffic.sent_bytes += len(sealed)
        return True

    def take(self, timeout_s: float) -> tuple[str, bytes] | None:
        """The next message somebody pushed, opened by the guard; None when none came or it was refused."""
        taken = self.inbox.take(timeout_s)
        if taken is None or self._unseal is None:
            return taken
        payload = self._unseal(taken[1])
        if payload is None:
            self.traffic.refused += 1
            return None
        return taken[0], payload

    # Answering pulls.

    def _answer_queries(self) -> None:
        while not self._closed.is_set():
            try:
                query = self._queries.get(timeout=0.2)
            except queue.Empty:
                continue
            try:
                with query:
                    self._answer_query(query)
            except Exception:
                log.exception("network: a query was not answered")

    def _answer_query(self, query: Any) -> None:
        key, request = str(query.key_expr), query.payload.to_bytes() if query.payload is not None else b""
        index = query.parameters.get("i")
        if len(request) > MAX_HINT_BYTES or index is None or not index.isascii() or not index.isdigit() or len(index) > 5:
            self.traffic.refused += 1
            return
        kept = self._content(key, request)
        if kept is None:
            return
        content, digest = kept
        chunks = max(1, -(-len(content) // CHUNK_BYTES))
        if int(index) >= chunks:
            return
        part = content[int(index) * CHUNK_BYTES : (int(index) + 1) * CHUNK_BYTES]
        header = CHUNK_HEADER.pack(CHUNK_MAGIC, chunks, len(content), digest)
        query.reply(key, part, attachment=header, congestion_control=zenoh.CongestionControl.DROP)
        self.traffic.served_bytes += len(part)

    def _content(self, key: str, request: bytes) -> tuple[bytes, bytes] | None:
        """The whole answer to a request; the same bytes for all chunks of one pull."""
        now = time.monotonic()
        kept = self._answers.get((key, request))
        if kept is not None and now - kept[0] < ANSWER_KEPT_S and len(kept[1]) > CHUNK_BYTES:
            return kept[1], kept[2]
        asked = request if self._unseal is None or not request else self._unseal(request)
        content = None if asked is None else self._answer(key, asked)
        if content is not None and self._seal is not None:
            content = self._seal(content)
        if content is None or len(content) > MAX_PULL_BYTES:
            return None
        digest = hashlib.sha256(content).digest()
        self._answers[key, request] = (now, content, digest)
        while len(self._answers) > MAX_ANSWERS_KEPT:
            self._answers.popitem(last=False)
        return content, digest

    # Pulling.

    def pull(self, key: str, request: bytes = b"", limit_bytes: int = MAX_PULL_BYTES) -> bytes | None:
        """Fetch what `key`'s owner answers to `request`; None when it did not come.  Waits: for a worker thread only."""
        sealed = request if self._seal is None or not request else self._seal(request)
        content = None if sealed is None else _Pull(self._session, key, sealed, limit_bytes, self._closed).run()
        if content is not None and self._unseal is not None:
            content = self._unseal(content)
        if content is None:
            self.traffic.failed_pulls += 1
            return None
        self.traffic.pulled_bytes += len(content)
        return content

    # What a person, or a test harness, wants to know.

    def locators(self) -> list[str]:
        """Where others can dial us: with port 0, the port that the system chose."""
        session = self._session
        if session is None:
            return []
        replies = _Replies()
        handler = zenoh.handlers.Callback(replies.on_reply, replies.on_end, indirect=False)
        session.get(f"@/{session.zid()}/{self.settings.mode}", handler, timeout=2.0)
        while (reply := replies.arrived.get(timeout=3.0)) is not None:
            if reply.ok is not None:
                return [str(locator) for locator in json.loads(reply.ok.payload.to_bytes())["locators"]]
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


class _Pull:
    """One receiver-paced transfer: two chunks in flight, each retried, the whole checked by its hash."""

    def __init__(self, session: Any, key: str, request: bytes, limit_bytes: int, closed: threading.Event) -> None:
        self.session, self.key, self.request, self.limit_bytes = session, key, request, limit_bytes
        self.closed = closed
        self.retries = 0

    def run(self) -> bytes | None:
        try:
            return self._run()
        except zenoh.ZError as error:  # closed under us
            log.debug("pull %s: %s", self.key, error)
            return None

    def _run(self) -> bytes | None:
        if self.session is None:
            return None
        while (first := self._chunk(0)) is not None:
            header, parts = first[0], {0: first[1]}
            if not self._plausible(header):
                return None
            if self._rest(header, parts):
                content = b"".join(parts[i] for i in range(header[1]))
                if len(content) == header[2] and hashlib.sha256(content).digest() == header[3]:
                    return content
            if not self._may_retry():  # the owner's content changed on the way, or lies about its hash
                return None
        return None

    def _plausible(self, header: tuple[bytes, int, int, bytes]) -> bool:
        magic, chunks, size, _ = header
        return magic == CHUNK_MAGIC and size <= self.limit_bytes and chunks == max(1, -(-size // CHUNK_BYTES))

    def _rest(self, header: tuple[bytes, int, int, bytes], parts: dict[int, bytes]) -> bool:
        """All chunks after the first, always two asked for; False when the content changed or a chunk never came."""
        asked = {i: self._ask(i) for i in range(1, min(1 + CHUNKS_IN_FLIGHT, header[1]))}
        for i in range(1, header[1]):
            got = self._receive(asked.pop(i)) or self._chunk(i)
            if got is None or got[0] != header:
                return False
            parts[i] = got[1]
            if i + CHUNKS_IN_FLIGHT < header[1]:
                asked[i + CHUNKS_IN_FLIGHT] = self._ask(i + CHUNKS_IN_FLIGHT)
        return True

    def _chunk(self, index: int) -> tuple[tuple[bytes, int, int, bytes], bytes] | None:
        """One chunk, retried: an empty answer is how Zenoh says that nobody was there just now."""
        while not self.closed.is_set():
            got = self._receive(self._ask(index))
            if got is not None or not self._may_retry():
                return got
            self.closed.wait(0.1 * self.retries)
        return None

    def _may_retry(self) -> bool:
        self.retries += 1
        return self.retries <= MAX_RETRIES and not self.closed.is_set()

    def _ask(self, index: int) -> _Replies:
        replies = _Replies()
        self.session.get(
            f"{self.key}?i={index}",
            zenoh.handlers.Callback(replies.on_reply, replies.on_end, indirect=False),
            payload=self.request or None,
            consolidation=zenoh.ConsolidationMode.NONE,
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.BACKGROUND,
            timeout=CHUNK_TIMEOUT_S,
        )
        return replies

    def _receive(self, replies: _Replies) -> tuple[tuple[bytes, int, int, bytes], bytes] | None:
        deadline = time.monotonic() + CHUNK_TIMEOUT_S + 1.0
        while not self.closed.is_set() and time.monotonic() < deadline:
            try:
                reply = replies.arrived.get(timeout=0.2)
            except queue.Empty:
                continue
            if reply is None:
                return None
            sample = reply.ok
            if sample is None or sample.attachment is None or len(sample.attachment) != CHUNK_HEADER.size:
                continue
            part = sample.payload.to_bytes()
            if len(part) <= CHUNK_BYTES:
                return CHUNK_HEADER.unpack(sample.attachment.to_bytes()), part
        return None
