"""What to pull next: small registers first, few large ones at a time, and patience with whoever does not answer."""

from __future__ import annotations

from dataclasses import dataclass

from agent.fleet.effects import Fetch
from agent.fleet.ledger import Ledger

_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.5, 3.0  # a question costs 200 B; who is lost is not asked at all
BULK = frozenset({"coarse", "fine", "tiles", "estate"})


@dataclass(slots=True)
class _Patience:
    failures: int = 0
    not_before_s: float = 0.0


class Fetching:
    """At most one pull per (peer, subject) at a time."""

    def __init__(self, ledger: Ledger) -> None:
        self._ledger = ledger
        self._running: dict[tuple[str, str], tuple[Fetch, float]] = {}
        self._patience: dict[tuple[str, str], _Patience] = {}

    def want(self, peer: str, subject: str, key: str, now_s: float) -> None:
        """Start the pull, unless it runs already, failed just now, or too many run."""
        name = (peer, subject)
        options = self._ledger.options
        running = self._running.get(name)
        if running is not None and now_s - running[1] < options.fetch_timeout_s:
            return
        patience = self._patience.get(name)
        if patience is not None and now_s < patience.not_before_s:
            return
        is_bulk = subject in BULK
        if self._count(is_bulk, now_s) >= (options.max_bulk_fetches if is_bulk else options.max_small_fetches):
            return
        fetch = Fetch(self._ledger.new_id(), peer, key, is_bulk)
        self._running[name] = (fetch, now_s)
        self._ledger.effects.append(fetch)

    def done(self, fetch: Fetch, is_good: bool, now_s: float) -> str | None:
        """Take the answer in; its subject, or None when nobody waits for it any more."""
        name = next((name for name, (running, _) in self._running.items() if running.id == fetch.id), None)
        if name is None:
            return None
        del self._running[name]
        if is_good:
            self.forgive(fetch.peer)  # it answers again
        else:
            patience = self._patience.setdefault(name, _Patience())
            patience.failures += 1
            patience.not_before_s = now_s + min(_FIRST_PAUSE_S * 2.0**patience.failures, _LONGEST_PAUSE_S)
        return name[1]

    def begin_anew(self, peer: str) -> None:
        """A peer that came back is asked at once, whatever went unanswered before."""
        self.forgive(peer)
        for name in [name for name in self._running if name[0] == peer]:
            del self._running[name]

    def forgive(self, peer: str) -> None:
        """A peer that is heard again after some silence: what failed meanwhile may be asked again at once."""
        for name in [name for name in self._patience if name[0] == peer]:
            del self._patience[name]

    def _count(self, is_bulk: bool, now_s: float) -> int:
        limit_s = self._ledger.options.fetch_timeout_s
        return sum(fetch.is_bulk == is_bulk and now_s - since_s < limit_s for fetch, since_s in self._running.values())
