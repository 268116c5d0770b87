"""Numbers on the command line, each with the least and the most it may be: `add_argument("--noise", type=number(0, 10))`."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable


def number(least: float = -math.inf, most: float = math.inf) -> Callable[[str], float]:
    """A finite number within bounds, or one sentence that names them."""

    def parsed(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not (math.isfinite(value) and least <= value <= most):
            raise argparse.ArgumentTypeError(f"{text!r} is no number {_bounds(least, most)}".rstrip())
        return value

    return parsed


def whole(least: int, most: int = 2**63 - 1) -> Callable[[str], int]:
    """A whole number within bounds."""

    def parsed(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = least - 1
        if not least <= value <= most:
            raise argparse.ArgumentTypeError(f"{text!r} is no whole number {_bounds(least, most)}")
        return value

    return parsed


def _bounds(least: float, most: float) -> str:
    if most == 2**63 - 1 or math.isinf(most):
        return "" if math.isinf(least) else f"of at least {least:g}"
    return f"from {least:g} to {most:g}"
