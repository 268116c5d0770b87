"""What the doctor looks at and what it says: a machine, and findings with the one command that mends each."""

from __future__ import annotations

import enum
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from agent.config import Config


class Level(enum.Enum):
    OK = "OK"
    WARN = "WARN"
    FAIL = "FAIL"


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the doctor's report."""

    level: Level
    what: str
    finding: str
    mend: str = ""  # a command


@dataclass(frozen=True, slots=True)
class Machine:
    """What is looked at; `root` is where the file system begins."""

    config: Config
    environ: Mapping[str, str]
    root: Path = Path("/")
    groups: frozenset[str] = field(default_factory=frozenset)
    user: str = "pi"


Check = Callable[[Machine], Iterator[Finding]]


def ok(what: str, finding: str) -> Finding:
    return Finding(Level.OK, what, finding)


def text_of(path: Path) -> str:
    """What a file holds; nothing when it cannot be read."""
    try:
        return path.read_text(errors="replace")
    except OSError:
        return ""
