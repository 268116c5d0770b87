"""A line that was damaged a while ago may hand on a damaged scan whose sum is right by chance: its scans are filtered.

One bad SICK telegram in 65536 passes its 16-bit sum, and a SCIP line's 6-bit sum passes one change in 64.  Such a scan cannot
be told by its bytes, but by its company: the line it comes on has been damaged before.  For a scan to be wrong and not
filtered, its damage must come after N clean scans; of scans damaged with chance p that is p (1 - p)^N, at most 1 / (e N).
"""

from __future__ import annotations

SUSPECT_SCANS = 100  # N; the filter costs beams of a noisy scanner, so it ends seconds after the last damage
FIRST_SCANS = 8  # suspect when the first frame stands behind other bytes, which need not be damage


class Suspicion:
    """Counts clean scans since the last damage."""

    def __init__(self) -> None:
        self._left = 0
        self._has_begun = False

    def __bool__(self) -> bool:
        """Is the line suspect?"""
        return self._left > 0

    def note(self, gap_bytes: int) -> None:
        """A good frame came, behind so many bytes that belong to none; before the first we came in the middle of one."""
        after_damage = SUSPECT_SCANS if self._has_begun else FIRST_SCANS
        self._left = after_damage if gap_bytes else max(0, self._left - 1)
        self._has_begun = True
