"""The flat corner of YAML that map_server files are written in: `key: value`, with lists in brackets or dashes.

Values come back as text, or as a list of text.  Everything else of YAML (anchors, tags, nesting) is refused where a known
key uses it, and passed over where it stands below a key of somebody else's.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

MAX_LIST = 1000
MAX_LIST_CHARS = 16_000
_OPEN_LIST = re.compile(r"[A-Za-z_][\w.\-]*\s*:\s+\[[^\]]*$")
_KEY = re.compile(r"""(?P<quote>["']?)(?P<key>[A-Za-z_][\w.\-]*)(?P=quote)\s*:(?:\s+(?P<value>.*))?$""")


class FlatYamlError(ValueError):
    """Text that is not flat YAML: says the line."""


def decoded(data: bytes) -> str:
    """UTF-8, or what Windows writes: UTF-16 begins with its mark, and the letters of Latin-1 stand in comments and names only."""
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return data.decode("utf-16", "replace")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def parse_flat_yaml(text: str) -> dict[str, str | list[str]]:
    """Every top-level key with its value."""
    values: dict[str, str | list[str]] = {}
    key = ""
    for number, line in _whole_lines(text):
        if not line or line in ("---", "...") or line.startswith("%"):
            continue
        item = re.match(r"\s*-\s+(.*)$", line)
        if item and key:
            _append(values, key, item[1], number)
        elif line[0].isspace():
            values.pop(key, None)  # nested below `key`: nothing of ours is
        else:
            key = _top_level(values, line, number)
    return values


def _whole_lines(text: str) -> Iterator[tuple[int, str]]:
    """Lines without comments, by the number they begin at; a list in brackets that goes on below is one line."""
    begun, open_list = 0, ""
    for number, raw in enumerate(text.splitlines(), 1):
        line = _without_comment(raw).rstrip()
        if open_list:
            line = f"{open_list} {line.strip()}"
        if _OPEN_LIST.match(line) and len(line) < MAX_LIST_CHARS:
            begun, open_list = begun if open_list else number, line
            continue
        yield begun if open_list else number, line
        open_list = ""
    if open_list:
        yield begun, open_list


def _top_level(values: dict[str, str | list[str]], line: str, number: int) -> str:
    match = _KEY.match(line)
    if not match:
        raise FlatYamlError(f"line {number}: expected 'key: value', saw {line[:60]!r}")
    key = match["key"]
    if key in values:
        raise FlatYamlError(f"line {number}: '{key}' is given twice")
    values[key] = _value((match["value"] or "").strip(), number)
    return key


def _append(values: dict[str, str | list[str]], key: str, text: str, number: int) -> None:
    held = values.get(key, "")
    if held == "":
        held = values[key] = []
    if not isinstance(held, list) or len(held) >= MAX_LIST:
        raise FlatYamlError(f"line {number}: unexpected list item below '{key}'")
    held.append(_scalar(text.strip(), number))


def _value(text: str, number: int) -> str | list[str]:
    if not text.startswith("["):
        return _scalar(text, number)
    if not text.endswith("]") or text.count("[") != 1:
        raise FlatYamlError(f"line {number}: expected a list like [1.0, 2.0, 0.0], saw {text[:60]!r}")
    return [_scalar(part.strip(), number) for part in text[1:-1].split(",", MAX_LIST) if part.strip()]


def _scalar(text: str, number: int) -> str:
    if text[:1] in ('"', "'"):
        if len(text) < 2 or text[-1] != text[0]:
            raise FlatYamlError(f"line {number}: the quote is not closed: {text[:60]!r}")
        return text[1:-1]
    if text[:1] in ("&", "*", "!", "{", "|", ">"):
        raise FlatYamlError(f"line {number}: only plain values can be read here, saw {text[:60]!r}")
    return text


def _without_comment(line: str) -> str:
    """Up to the first # that starts a word outside of quotes."""
    quote = ""
    for i, letter in enumerate(line):
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "\"'" and (i == 0 or line[i - 1] in " \t[,"):
            quote = letter
        elif letter == "#" and (i == 0 or line[i - 1].isspace()):
            return line[:i]
    return line
