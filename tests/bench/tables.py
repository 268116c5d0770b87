"""Rows of figures as the Markdown table that goes into a page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence


def markdown(rows: Sequence[Mapping[str, object]]) -> str:
    """One line a row, the columns of the first; a row may leave some out."""
    columns = list(rows[0]) if rows else []
    lines = [columns, ["---"] * len(columns), *([_cell(row.get(name, "")) for name in columns] for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def next_line(row: Mapping[str, object], is_first: bool) -> str:
    """One more line of a table that is printed while it grows; the first brings the heading."""
    lines = markdown([row]).splitlines()
    return "\n".join(lines if is_first else lines[2:])


def _cell(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
