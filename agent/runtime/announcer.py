"""A Zenoh session that only speaks: it says what is there, and keeps the last word on a topic for those who come late.

That is ROS 2's transient local durability as rmw_zenoh does it.  Zenoh sends the heartbeats behind it with BLOCK, so a listener
that dies silently may hold this session up for seconds: it shares nothing
with the fleet's, and its callers have a thread of their own.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Mapping
from typing import Any

import zenoh
import zenoh.ext

from agent.runtime.exchange import ExchangeError, close

log = logging.getLogger(__name__)

HEARTBEAT_S = 0.5  # of a kept topic: a listener that missed the last word learns so from it; rmw_zenoh's own figure


class Announcer:
    """One Zenoh session that hears nothing."""

    def __init__(self, config: Mapping[str, Any]) -> None:
        self._config = dict(config)
        self._session: Any = None
        self._held: list[Any] = []  # tokens and publishers: Zenoh takes back what nobody holds

    def open(self) -> None:
        try:
            self._session = zenoh.open(zenoh.Config.from_json5(json.dumps(self._config)))
        except zenoh.ZError as error:
            raise ExchangeError(f"network: cannot open with {json.dumps(self._config)}: {error}") from error

    @property
    def id(self) -> str:
        """The session's own name, in hexadecimal."""
        return str(self._session.zid())

    def announce(self, key: str) -> None:
        """A liveliness token, there until the session ends."""
        self._held.append(self._session.liveliness().declare_token(key))

    def publisher(self, key: str, kept: int) -> Callable[[bytes, bytes], None]:
        """(payload, attachment) -> out; the last `kept` are given to whoever comes later (0: to nobody)."""
        more: dict[str, Any] = {}
        if kept:
            more["cache"] = zenoh.ext.CacheConfig(kept)
            more["sample_miss_detection"] = zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=HEARTBEAT_S)
            more["publisher_detection"] = True
        publisher = zenoh.ext.declare_advanced_publisher(
            self._session, key, congestion_control=zenoh.CongestionControl.DROP, **more
        )
        self._held.append(publisher)

        def put(payload: bytes, attachment: bytes) -> None:
            try:
                publisher.put(payload, attachment=attachment)
            except zenoh.ZError as error:
                log.debug("announce %s: %s", key, error)

        return put

    def close(self) -> None:
        """Never raises; everything announced is taken back with the session."""
        session, self._session = self._session, None
        close(session)
        self._held.clear()
