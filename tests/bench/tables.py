"""Rows of figures as the Markdown table that goes into a page, or as JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path


def markdown(rows: Sequence[Mapping[str, object]]) -> str:
    """One line a row; a row may leave columns out."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    return "\n".join([heading(columns), *(line(row, columns) for row in rows)])


def heading(columns: Sequence[str]) -> str:
    """The names of the columns, and the rule below them."""
    return f"{_joined(columns)}\n{_joined(['---'] * len(columns))}"


def line(row: Mapping[str, object], columns: Sequence[str]) -> str:
    """One row, for those who tell theirs as they are measured."""
    return _joined([_cell(row.get(name)) for name in columns])


def print_row(figures: Mapping[str, object], *, as_json: bool) -> None:
    """One row of Markdown, or one line of JSON."""
    print_rows([figures], as_json=as_json)


def print_rows(rows: Sequence[Mapping[str, object]], *, as_json: bool) -> None:
    """A Markdown table, or one line of JSON a row."""
    print("\n".join(map(json.dumps, rows)) if as_json else markdown(rows))


def write_json(path: Path | None, figures: object) -> None:
    """The figures in a file too, when one is named."""
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(figures, indent=1) + "\n")


def _joined(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _cell(value: object) -> str:
    return "" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)
