"""What may pass through the door to the network at once, and what has passed."""

from __future__ import annotations

from dataclasses import dataclass

MAX_PAYLOAD_BYTES = 32 * 1024  # hints are made for 16 KB, plus envelope; a single 200 KB put is silently lost on 20 Mbit/s


@dataclass(slots=True)
class Traffic:
    """Counts since the start."""

    sent_bytes: int = 0
    received_messages: int = 0
    received_bytes: int = 0
    pulled_bytes: int = 0
    served_bytes: int = 0
    refused: int = 0  # too large, or said while there was no session
    unanswered: int = 0
    dropped_queries: int = 0
