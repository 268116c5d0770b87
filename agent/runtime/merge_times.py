"""How long a fit takes and how long it lasts, told from the notes: when a peer was first heard, when an edge began and ended."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

KEPT_PEERS = 1024


class MergeTimes:
    """Give it every note with its time on our clock."""

    def __init__(self) -> None:
        self._heard_s: dict[str, float] = {}  # peers, since they joined or started again
        self._took_s: dict[str, float] = {}
        self._since_s: dict[frozenset[str], float] = {}

    def add(self, event: str, facts: Mapping[str, Any], now_s: float) -> None:
        """One note; those that say nothing of joining or merging are passed over."""
        if event in ("peer-joined", "peer-restarted"):
            if len(self._heard_s) < KEPT_PEERS:
                self._heard_s[facts["peer"]] = now_s
            self._took_s.pop(facts["peer"], None)
        elif event == "merged":
            pair = frozenset((facts["a"], facts["b"]))
            if len(self._since_s) >= KEPT_PEERS:
                self._since_s.pop(next(iter(self._since_s)))
            self._since_s[pair] = now_s
            peers = [robot for robot in pair if robot in self._heard_s]
            if len(peers) == 1:  # the other one is ourselves
                self._took_s.setdefault(peers[0], now_s - self._heard_s[peers[0]])

    def edge_age_s(self, a: str, b: str, now_s: float) -> float | None:
        """Since this edge last began."""
        since_s = self._since_s.get(frozenset((a, b)))
        return None if since_s is None else round(now_s - since_s, 1)

    def took(self) -> dict[str, Any] | None:
        """From hearing a peer first to the first fit with it: median, slowest tenth and slowest, over the peers that fitted."""
        if not (took := sorted(self._took_s.values())):
            return None
        at = {"p50_s": 0.5, "p90_s": 0.9, "max_s": 1.0}
        return {"peers": len(took)} | {name: round(took[round(share * (len(took) - 1))], 1) for name, share in at.items()}
