"""Log lines for the person on call: to stderr, with systemd's priorities under systemd, with the time elsewhere."""

from __future__ import annotations

import logging
import os
import re
import sys

PRIORITY = {logging.DEBUG: 7, logging.INFO: 6, logging.WARNING: 4, logging.ERROR: 3, logging.CRITICAL: 2}
CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")  # a peer's text must not steer a terminal or forge a line


class OneLine(logging.Formatter):
    """Control characters escaped; a traceback keeps its lines, indented."""

    def format(self, record: logging.LogRecord) -> str:
        text = CONTROL.sub(lambda match: f"\\x{ord(match[0]):02x}", super().format(record)).replace("\n", "\n  ")
        return f"<{PRIORITY.get(record.levelno, 6)}>{text}" if self._is_journal else text

    _is_journal = bool(os.environ.get("JOURNAL_STREAM"))


def set_up_logging(level: str, robot: str) -> None:
    prefix = "" if os.environ.get("JOURNAL_STREAM") else "%(asctime)s "
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(OneLine(f"{prefix}{robot} %(levelname)s %(message)s"))
    logging.basicConfig(level=level.upper(), handlers=[handler], force=True)
