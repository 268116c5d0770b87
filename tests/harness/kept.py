"""Records of a long campaign, one a line, so that the same command goes on where it was stopped."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from typing import Any

Record = dict[str, Any]


def kept(path: Path | None) -> list[Record]:
    """What was written down before; a line that a kill tore in two is nothing."""
    records = []
    if path is not None and path.exists():
        for line in path.read_text().splitlines():
            with contextlib.suppress(json.JSONDecodeError):
                records.append(json.loads(line))
    return records


def keep(path: Path | None, record: Record) -> None:
    if path is not None:
        with path.open("a") as file:
            file.write("\n" + json.dumps(record))
