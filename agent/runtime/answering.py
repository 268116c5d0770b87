"""Peers' queries, answered on a thread of our own: Zenoh's only hands them over, and never waits for an answer to be made."""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable
from typing import Any

from agent.runtime.pending import NO_SUCH_REGISTER
from agent.runtime.traffic import MAX_PAYLOAD_BYTES, Traffic

log = logging.getLogger(__name__)

MAX_QUERIES_WAITING = 256

Answer = Callable[[str], "bytes | None"]  # key -> the register's content, ready to travel; runs on the answering thread


class Answering:
    """The queries that wait, and the thread that answers them until `closed` is set.

    `gone` is what a reply raises when its asker has left.
    """

    def __init__(self, answer: Answer, traffic: Traffic, closed: threading.Event, gone: type[Exception]) -> None:
        self._answer, self._traffic, self._closed, self._gone = answer, traffic, closed, gone
        self._queries: queue.Queue[Any] = queue.Queue(maxsize=MAX_QUERIES_WAITING)
        self._thread = threading.Thread(target=self._run, name="answers", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def join(self) -> None:
        if self._thread.is_alive():
            self._thread.join(2.0)

    def on_query(self, query: Any) -> None:
        """Zenoh's callback: one bounded enqueue."""
        try:
            self._queries.put_nowait(query)
        except queue.Full:
            self._traffic.dropped_queries += 1
            query.drop()  # a query that is kept makes the other side wait for its timeout

    def _run(self) -> None:
        while not self._closed.is_set():
            try:
                query = self._queries.get(timeout=0.2)
            except queue.Empty:
                continue
            try:
                with query:
                    self._reply(query)
            except self._gone as error:
                log.debug("network: the asker is gone: %s", error)
            except Exception:
                log.exception("network: a query was not answered")

    def _reply(self, query: Any) -> None:
        key = str(query.key_expr)
        if "*" in key:
            return
        content = self._answer(key)
        if content is None or len(content) > MAX_PAYLOAD_BYTES:
            query.reply_err(NO_SUCH_REGISTER)
            return
        query.reply(key, content)  # as droppable as the query it answers
        self._traffic.served_bytes += len(content)
