"""What the kernel says of a process: for campaigns that watch robots from outside."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path


def resident_mb(pid: int) -> float:
    """Memory that is in RAM now; 0 when the process is gone."""
    return _status(pid, "VmRSS:") / 1024


def peak_mb(pid: int) -> float:
    """The most memory that was ever in RAM."""
    return _status(pid, "VmHWM:") / 1024


def own_share_mb(pid: int) -> float:
    """Memory in RAM, what is shared with other processes divided among them (PSS): the sum over robots is what they cost."""
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    except OSError:
        return 0.0
    return next((int(line.split()[1]) for line in lines if line.startswith("Pss:")), 0) / 1024


def threads(pid: int) -> int:
    return _status(pid, "Threads:")


def open_files(pid: int) -> int:
    """Files, sockets and pipes."""
    try:
        return len(os.listdir(f"/proc/{pid}/fd"))
    except OSError:
        return 0


def cpu_s(pid: int) -> float:
    """User and system time since the process started."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _status(pid: int, name: str) -> int:
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) for line in lines if line.startswith(name)), 0)


def percentile(values: Sequence[float], share: float) -> float:
    """The value that this share of all values does not exceed; NaN of nothing."""
    ordered = sorted(values)
    return ordered[max(0, math.ceil(share * len(ordered)) - 1)] if ordered else math.nan
