"""Another process with our name: the younger of the two falls silent until the other is gone."""

from __future__ import annotations

from dataclasses import dataclass

from agent.fleet.ledger import Ledger
from agent.fleet.timetable import LONG_AGO_S
from protocol.messages import Beat, Message

_GONE_AFTER_BEATS = 3.0


@dataclass(slots=True)
class _Twin:
    """Another process that uses our name."""

    boot: int
    seq: int = 0
    beats: int = 0
    heard_s: float = LONG_AGO_S
    period_s: float = 1.0


class TwinWatch:
    """Listens for our own name."""

    def __init__(self, ledger: Ledger) -> None:
        self._ledger = ledger
        self._twin: _Twin | None = None
        self.is_twin = False  # we are the younger: nothing is published

    def on_own_name(self, message: Message, now_s: float) -> None:
        """Somebody spoke under our name: two timely beats of another boot are a living process."""
        if message.boot == self._ledger.boot or not isinstance(message, Beat):
            return
        if self._twin is None or self._twin.boot != message.boot:
            self._twin = _Twin(message.boot)
        twin = self._twin
        if message.seq <= twin.seq or now_s - twin.heard_s < 0.5 * message.period_s:
            return  # late beats of our own former life come in bursts
        twin.seq, twin.beats, twin.heard_s, twin.period_s = message.seq, twin.beats + 1, now_s, message.period_s
        if twin.beats < 2:
            return
        is_younger = (self._ledger.clock.now_s, -self._ledger.boot) < (message.uptime_s, -message.boot)
        if is_younger and not self.is_twin:
            self.is_twin = True
            self._ledger.note(
                "twin", is_warning=True, robot=self._ledger.robot, advice="another process uses this name: rename one"
            )

    def check(self, now_s: float) -> None:
        """Speak again when the other has missed some beats: at its next two we fall silent once more."""
        if self.is_twin and self._twin is not None and now_s - self._twin.heard_s > _GONE_AFTER_BEATS * self._twin.period_s:
            self.is_twin, self._twin = False, None
