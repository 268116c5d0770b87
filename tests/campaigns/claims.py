"""Claims with a bar each, as a campaign that walks through a story finds them: one line of its table a claim."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass

from tests.bench.tables import markdown


@dataclass(frozen=True)
class Claim:
    """One line of the table."""

    claim: str
    bar: str
    measured: str
    holds: bool


def judged(claims: Sequence[Claim], *, as_json: bool) -> int:
    """Print them; the exit code: 0 when all hold."""
    rows = [{"claim": c.claim, "bar": c.bar, "measured": c.measured, "": "holds" if c.holds else "FAILS"} for c in claims]
    print(json.dumps([asdict(claim) for claim in claims], indent=1) if as_json else markdown(rows))
    return 0 if all(claim.holds for claim in claims) else 1
