"""Device URLs: `scheme:path?option=value&option=value`, for example `ld06:/dev/ttyUSB0` or `sim:office?seed=3`."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from dataclasses import dataclass, field
from urllib.parse import parse_qsl

from hw.errors import DeviceConfigError


@dataclass(frozen=True, slots=True)
class DeviceUrl:
    """A device URL taken apart."""

    text: str
    scheme: str
    path: str
    options: dict[str, str] = field(default_factory=dict)

    def only(self, known: Iterable[str]) -> DeviceUrl:
        """Itself, when it has no option but these; else an error with a suggestion."""
        for key in self.options:
            if key not in known:
                close = difflib.get_close_matches(key, list(known), 1)
                hint = f"did you mean '{close[0]}'?" if close else f"it knows {', '.join(sorted(known)) or 'no options'}"
                raise DeviceConfigError(f"{self.text}: unknown option '{key}'; {hint}")
        return self

    def number(self, key: str, default: float, least: float = 0.0, most: float = float("inf")) -> float:
        """An option that is a number, within bounds."""
        if key not in self.options:
            return default
        try:
            value = float(self.options[key])
        except ValueError:
            value = float("nan")
        if not least <= value <= most:
            raise DeviceConfigError(f"{self.text}: {key}={self.options[key]} must be a number from {least:g} to {most:g}")
        return value

    def integer(self, key: str, default: int, least: int = 0, most: int = 2**31) -> int:
        """An option that is a whole number, within bounds."""
        value = self.number(key, default, least, most)
        if value != int(value):
            raise DeviceConfigError(f"{self.text}: {key}={self.options[key]} must be a whole number")
        return int(value)

    def text_of(self, key: str, default: str, allowed: Iterable[str] = ()) -> str:
        """An option that is a word, one of `allowed` unless that is empty."""
        value = self.options.get(key, default)
        choices = list(allowed)
        if choices and value not in choices:
            raise DeviceConfigError(f"{self.text}: {key}={value} must be one of {', '.join(choices)}")
        return value


def parse_url(text: str) -> DeviceUrl:
    """Take a URL apart, or say what is wrong with it."""
    scheme, colon, rest = text.partition(":")
    if not colon or not scheme:
        raise DeviceConfigError(f"'{text}' is no device URL; write for example ld06:/dev/ttyUSB0 or sim:office")
    path, _, query = rest.partition("?")
    try:
        pairs = parse_qsl(query, keep_blank_values=True, strict_parsing=bool(query))
    except ValueError as error:
        raise DeviceConfigError(f"{text}: options are written ?name=value&name=value ({error})") from error
    return DeviceUrl(text, scheme.lower(), path, dict(pairs))
