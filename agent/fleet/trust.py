"""How much a peer is believed: provable untruths are strikes, strikes fade, too many are quarantine."""

from __future__ import annotations

from dataclasses import dataclass, field

_FADE_S = 60.0  # one strike is forgotten after this long without another

STRIKES = {
    "garbage": 0.34,  # bytes that no honest robot sends; on an open network anybody can write them in its name
    "forged map": 1.0,  # cells that are not what they were announced to be
    "forged global map": 1.0,
    "equivocation": 3.0,  # two different statements under one number: nobody says that by accident
    "false proposal": 0.5,  # another transform on the very maps on which one was refused already
    # A particle filter that changes its mind redraws its map honestly: the edge falls and is verified anew, and the strike is
    # forgotten before many can follow.  Redrawn maps move in pieces that are found again; only inventions deny themselves.
    "map turned false": 0.2,  # a map that fitted begins to contradict ours
    "map denies itself": 3.0,  # nearly all walls are gone from where two others still see them, and found nowhere near
}


@dataclass(slots=True)
class Trust:
    """What one peer has on its account."""

    strikes: float = 0.0
    counted_s: float = 0.0
    quarantined_until_s: float = -1.0
    reasons: dict[str, int] = field(default_factory=dict)

    def strike(self, reason: str, limit: int, quarantine_s: float, now_s: float) -> bool:
        """Put one more on the account; True when this is what sends the peer to quarantine."""
        self.strikes = max(0.0, self.strikes - (now_s - self.counted_s) / _FADE_S) + STRIKES[reason]
        self.counted_s = now_s
        self.reasons[reason] = self.reasons.get(reason, 0) + 1
        if self.strikes < limit or self.is_quarantined(now_s):
            return False
        self.quarantined_until_s = now_s + quarantine_s
        return True

    def is_quarantined(self, now_s: float) -> bool:
        return now_s < self.quarantined_until_s

    def pardon(self) -> None:
        self.strikes, self.quarantined_until_s = 0.0, -1.0
